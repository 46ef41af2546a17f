// What both pages use.
"use strict";

const STEPS = { ArrowLeft: [0, -1], ArrowRight: [0, 1], ArrowUp: [-1, 0], ArrowDown: [1, 0] }; // rows and columns
const element = (id) => document.getElementById(id);
const notice = (text) => { element("notice").textContent = text; };
const create = (name, properties) => Object.assign(document.createElement(name), properties);
const loadScript = (src) => new Promise((onload, onerror) => {
  document.head.append(create("script", { src, onload, onerror }));
});

/** Decode base64, inflate, and view as a typed array. */
async function unpack(text, ArrayType) {
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const inflated = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new ArrayType(await new Response(inflated).arrayBuffer());
}
