// The page docs/find_on_all.md: found.py writes found/, which has every place that the page shows.
"use strict";

const FOUND = {}; // by category; the files of found/ fill it
// Coordinates are 0 to FULL, or HIDDEN; a place of less confidence than LEAST, of 256, is not shown.
const FULL = 254, HIDDEN = 255, LEAST = 128;
const state = { objects: [], side: 0, source: 0, mark: 0, held: false };

async function openCategory(name) {
  element("objects").setAttribute("aria-busy", "true");
  if (!FOUND[name]) await loadScript(`../_static/found/${name}.js`);
  const objects = await Promise.all(FOUND[name].map(async (stored) => ({
    ...stored, pixels: await unpack(stored.pixels, Uint8Array), places: await unpack(stored.places, Uint16Array),
    confidences: await unpack(stored.confidences, Uint8Array),
  })));
  if (element("category").value !== name) return; // another one was chosen meanwhile
  Object.assign(state, { objects, source: 0, mark: 0, held: false });
  element("objects").replaceChildren(...objects.map(figure));
  turn();
  markNearest(0, [FULL / 2, FULL / 2]);
  element("objects").setAttribute("aria-busy", "false");
}

/** The pictures and the mark of object i. */
function figure(_, i) {
  const whole = create("figure");
  const picture = create("div", { className: "picture", tabIndex: 0, role: "application" });
  picture.ariaLabel = `Object ${i + 1}. Arrow keys move the mark, Enter holds and releases it.`;
  picture.append(create("img", { alt: "", draggable: false }), create("span"));
  Object.assign(picture, { onpointermove: point, onpointerdown: point, onclick: point, onkeydown: press });
  whole.append(picture, create("figcaption"));
  return whole;
}

/** Show all objects from the chosen side. */
function turn() {
  state.side = Number(element("side").value);
  element("seen").value = state.side + 1;
  document.querySelectorAll("#objects img").forEach((image, i) => {
    const { pictures, sides } = state.objects[i];
    image.src = `data:image/webp;base64,${pictures[sides[state.side]]}`;
  });
  show();
}

/** Where a point of the surface of an object is in the picture that is shown. */
function pixelOf({ pixels, pictures, sides }, surfacePoint) {
  const first = 2 * (surfacePoint * pictures.length + sides[state.side]);
  return [pixels[first], pixels[first + 1]];
}

/** What is shown of the mark on object i. */
function placeOn(i) {
  const { objects, source, mark } = state, { starts, places, confidences } = objects[source];
  const at = i * starts.at(-1) + mark, pixel = pixelOf(objects[i], places[at]), confidence = confidences[at];
  if (confidence < LEAST) return { kind: "nothing", confidence, pixel };
  if (pixel[0] === HIDDEN) return { kind: "hidden", confidence, pixel };
  return { kind: i === source ? "mark" : "found", confidence, pixel };
}

/** Mark the patch in the picture of object i that is nearest to the pixel `from`, by a distance of columns and rows. */
function markNearest(i, from, distance = Math.hypot) {
  const object = state.objects[i], picture = object.sides[state.side];
  let least = Infinity;
  for (let one = object.starts[picture]; one < object.starts[picture + 1]; one++) {
    const [x, y] = pixelOf(object, one), far = distance(x - from[0], y - from[1]);
    if (far < least) [least, state.source, state.mark] = [far, i, one];
  }
  show();
}

function show() {
  const shown = state.objects.map((_, i) => placeOn(i));
  const count = (kind) => shown.filter((one, i) => i !== state.source && one.kind === kind).length;
  document.querySelectorAll("#objects figure").forEach((whole, i) => {
    const { kind, confidence, pixel: [x, y] } = shown[i], [picture, caption] = whole.children;
    whole.className = i === state.source ? "chosen" : kind;
    // Places and confidences as percent of 254 and of 256.
    Object.assign(picture.lastChild, { className: kind, style: `left: ${x / 2.54}%; top: ${y / 2.54}%` });
    caption.textContent = {
      mark: state.held ? "□ held" : "□ click to hold", found: `● ${Math.round(confidence / 2.56)} %`,
      nothing: "✕ nothing here", hidden: "hidden in this view",
    }[kind];
  });
  notice(`Marked on object ${state.source + 1}${state.held ? ", held" : ""}: found on ${count("found")} others, ` +
    `hidden on ${count("hidden")}, nothing here on ${count("nothing")}.`);
}

const indexOf = (event) => [...element("objects").children].indexOf(event.currentTarget.parentElement);

function point(event) {
  const place = pointedAt(event);
  if (place) markNearest(indexOf(event), place.map((share) => share * FULL));
}

function press(event) {
  const step = pressed(event), i = indexOf(event), { kind, pixel } = placeOn(i);
  if (!step) return show();
  const [down, right] = step, from = ["mark", "found"].includes(kind) ? pixel : [FULL / 2, FULL / 2];
  // The nearest point in the direction of the key, preferably straight on.
  markNearest(i, from, (x, y) => {
    const along = x * right + y * down, across = Math.abs(x * down) + Math.abs(y * right);
    return along > 0 ? along + 2 * across : Infinity;
  });
}

async function start() {
  const { value } = element("category");
  try { await openCategory(value); } catch { return; } // the notice says so
  element("category").onchange = (event) => openCategory(event.target.value);
  element("side").oninput = turn;
}

start();
