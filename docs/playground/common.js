// What both pages use. Each has its own `state`, whose field `held` says whether the mark stays where it is.
"use strict";

const STEPS = { ArrowLeft: [0, -1], ArrowRight: [0, 1], ArrowUp: [-1, 0], ArrowDown: [1, 0] }; // rows and columns
const element = (id) => document.getElementById(id);
const notice = (text) => { element("notice").textContent = text; };
const create = (name, properties) => Object.assign(document.createElement(name), properties);
const loadScript = (src) => new Promise((onload, onerror) => {
  document.head.append(create("script", { src, onload, onerror }));
});

/** Where a pointer is on a picture, from 0 to 1. A click holds or releases the mark; null while it is held. */
function pointedAt({ type, currentTarget, clientX, clientY }) {
  if (type === "click") state.held = !state.held;
  else if (state.held) return null;
  const { left, top, width, height } = currentTarget.getBoundingClientRect();
  return [(clientX - left) / width, (clientY - top) / height];
}

/** The step of an arrow key, which moves the mark. Enter and the space bar hold or release it. */
function pressed(event) {
  const step = STEPS[event.key], isHold = ["Enter", " "].includes(event.key);
  if (step || isHold) event.preventDefault();
  if (isHold) state.held = !state.held;
  return step;
}

/** Decode base64, inflate, and view as a typed array. */
async function unpack(text, ArrayType) {
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const inflated = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new ArrayType(await new Response(inflated).arrayBuffer());
}
