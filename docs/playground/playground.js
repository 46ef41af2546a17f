// The page: pairs, controls and pictures. method.js has the method; build.py writes playground/.
"use strict";

const CANVAS = 448, CELL = CANVAS / SIDE, CROP = 224; // sides in pixels: of a canvas, a patch, a photograph
const FIRST_PAIR = 3; // the pair that is shown first: cars that the method gets right
const MARKS = { // told apart by shape as well as by colour
  right: ["●", "#56b4e9"], wrong: ["✕", "#e69f00"], unknown: ["▲", "#d0d0d0"], u: ["□", "white"], back: ["○", "yellow"],
};
const LIBRARY_DEFAULTS = { saliency: 0.05, binned: true, cycle: true, k: 50, kmeans: true };
// The patch u starts in the middle; the angles `turn` of the 3D view are in radians.
const state = { views: [], solved: null, patch: 14 * SIDE + 14, held: false, shown: 0, turn: [0.5, 0.3] };

const all = (selector) => [...document.querySelectorAll(`#playground ${selector}`)];
const stageIs = (...names) => names.includes(document.querySelector("[name=stage]:checked").value);

/** The settings of the method by the names of their controls. */
function settings() {
  const inputs = all(".stages input[id]");
  return Object.fromEntries(inputs.map((one) => [one.id, one.type === "checkbox" ? one.checked : Number(one.value)]));
}

async function storedView(stored) {
  const picture = create("img", { src: `data:image/webp;base64,${stored.webp}` });
  await picture.decode();
  const rounded = await unpack(stored.keys, Int16Array), axes = rounded.length / PATCHES;
  const keys = Float32Array.from(rounded, (_, i) => DATA.steps[0] * rounded[i % axes * PATCHES + Math.floor(i / axes)]);
  const flat = Array.from(await unpack(stored.points, Int16Array), (value) => DATA.steps[1] * value);
  const points = Array.from({ length: PATCHES }, (_, u) => flat.slice(3 * u, 3 * u + 3));
  const truth = stored.truth && await unpack(stored.truth, Int16Array);
  return { ...stored, picture, keys, points, truth, saliency: await unpack(stored.saliency, Float32Array) };
}

async function openStored(index) {
  if (!STORED[index]) await loadScript(`playground/pair${index}.js`);
  await openViews(await Promise.all(STORED[index].map(storedView)));
  notice(DATA.runtime ? "Pictures of 3D models. Photographs that you choose stay on this computer: nothing is sent."
    : "Your own photographs are not possible here: onnxruntime-web could not be fetched when this site was built.");
}

/** Show views, the reference first, and compute what no setting changes: similarities and nearest neighbours. */
async function openViews(views) {
  Object.assign(state, { views, solved: null, held: false });
  element("pictures").setAttribute("aria-busy", "true");
  all("figure").forEach((figure, i) => { figure.hidden = figure.className ? i >= views.length : !views[0].points; });
  show(0);
  const described = views.map(({ keys }) => describe(keys));
  for (const [i, view] of views.entries()) {
    await new Promise((resolve) => { setTimeout(resolve); }); // the page stays responsive
    if (state.views !== views) return; // another pair was chosen meanwhile
    const { keys, descriptors } = similarities(described[0], described[i]);
    view.compared = [keys, descriptors].map(nearestNeighbours);
  }
  state.solved = solveViews(views, settings());
  show(state.solved.best);
  element("pictures").setAttribute("aria-busy", "false");
}

/** Whether v is within one patch of the true place of u, where that is known. */
function truthOf(target, u, v) {
  if (!(target.truth?.[u] >= 0)) return "unknown";
  const [[row1, column1], [row2, column2]] = [target.truth[u], v].map(rowColumn);
  return Math.max(Math.abs(row1 - row2), Math.abs(column1 - column2)) <= 1 ? "right" : "wrong";
}

/** All stages from foreground to pose. At the library's defaults the matches are those that it chose by k-means. */
function solveViews(views, chosen) {
  const on = views.map(({ saliency }) => Array.from(saliency, (value) => value > chosen.saliency));
  const isDefault = Object.entries(LIBRARY_DEFAULTS).every(([name, value]) => chosen[name] === value);
  const [reference, ...compared] = views.map((view) => view.compared[Number(chosen.binned)]);
  const targets = compared.map((one, i) => {
    const view = views[i + 1], distances = cyclicalDistances(one, on[0], on[i + 1]);
    const matches = isDefault && view.chosen ? view.chosen
      : findMatches(one, on[0], on[i + 1], views[0].saliency, reference.sim, chosen);
    return { ...one, ...view, on: on[i + 1], distances, matches, score: viewScore(one.sim, matches, chosen.k) };
  });
  const best = argMax(targets.map((target) => target.score)), { matches, points, rotation } = targets[best];
  const pose = points && ransac(matches.map(([u]) => views[0].points[u]), matches.map(([, v]) => points[v]),
    chosen.trials, chosen.threshold, state.draws);
  return { on: on[0], targets, best, pose, error: pose && rotationError(pose.R, rotation) };
}

/** Show all results for the patch u; lines and counts are those of target `view`. */
function show(view = state.shown) {
  state.shown = view;
  all(".image:not([hidden]) canvas").forEach((canvas, i) => {
    canvas.getContext("2d").drawImage(state.views[i].picture, 0, 0, CANVAS, CANVAS);
    if (state.solved) drawOverlay(canvas.getContext("2d"), i);
  });
  if (!state.solved) return;
  drawLines();
  drawCloud();
  const { solved: { targets, best } } = state, chosen = settings();
  const captions = [describePatch(), ...targets.map(describeNeighbour)], results = describeResults();
  all(".result").forEach((paragraph, i) => { paragraph.textContent = results[i]; });
  all("output").forEach((output) => { output.value = chosen[output.htmlFor]; });
  all(".image").forEach((figure, i) => {
    figure.classList.toggle("chosen", i === best + 1);
    figure.lastElementChild.textContent = captions[i];
  });
  all("#scores button").forEach((button, i) => {
    const score = targets[i]?.score;
    button.hidden = score === undefined;
    button.textContent = `View ${i + 1}: ${score?.toFixed(1)}${i === best ? ", chosen" : ""}`;
    button.style.setProperty("--share", 1 + score / (chosen.k * ORTHOGONAL));
    button.setAttribute("aria-pressed", i === view);
  });
}

function describePatch() {
  const { views, solved, patch, held } = state, ground = solved.on[patch] ? "foreground" : "background";
  const place = `row ${rowColumn(patch).join(", column ")}`, saliency = views[0].saliency[patch].toFixed(2);
  return `u: ${place}, saliency ${saliency} (${ground}), ${held ? "held" : "click to hold"}`;
}

function describeNeighbour({ sim, forth, distances }, view) {
  const u = state.patch, d = distances[u], back = d < Infinity ? `d(u, u′) ${d.toFixed(1)}` : "background on the way";
  return `View ${view + 1}: cosine ${sim[u * PATCHES + forth[u]].toFixed(2)}, ${back}`;
}

/** One line for each stage that counts something. */
function describeResults() {
  const { views, solved: { on, targets, pose, error }, shown } = state, { matches, distances } = targets[shown];
  const kinds = matches.map((match) => truthOf(targets[shown], ...match)), closed = distances.filter(Number.isFinite);
  const counts = ["right", "wrong", "unknown"].map((kind) => `${kinds.filter((one) => one === kind).length} ${kind}`);
  const reason = views[0].points ? "no four matches give one" : "points in space need depth, which photographs lack";
  const inliers = pose && `${sum(pose.inliers)} of ${pose.inliers.length} matches are inliers`;
  return [
    `${sum(on)} foreground patches in the reference`,
    `View ${shown + 1}: ${closed.filter((d) => d < 1.5).length} of ${closed.length} cycles end at u or next to it`,
    `View ${shown + 1}: ${matches.length} matches, ${counts.join(", ")}`,
    pose ? `${inliers}, scale ${pose.scale.toFixed(2)}, rotation error ${error.toFixed(1)}°` : `No pose: ${reason}`,
  ];
}

const middle = (patch) => rowColumn(patch).reverse().map((one) => (one + 0.5) * CELL);

/** Colour patches from dark blue (low) over green to light yellow (high), so that brightness alone tells values. */
function drawMap(context, values, low, high) {
  values.forEach((value, patch) => {
    const share = Math.min(Math.max((value - low) / (high - low), 0), 1), [x, y] = middle(patch);
    context.fillStyle = `hsl(${260 - 200 * share} 90% ${15 + 50 * share}% / 0.6)`;
    if (Number.isFinite(value)) context.fillRect(x - CELL / 2, y - CELL / 2, CELL, CELL);
  });
}

function drawMark(context, patch, kind, size) {
  const [sign, fillStyle] = MARKS[kind], font = `bold ${size}px sans-serif`;
  const style = { font, fillStyle, strokeStyle: "black", lineWidth: 5, textAlign: "center", textBaseline: "middle" };
  Object.assign(context, style).strokeText(sign, ...middle(patch));
  context.fillText(sign, ...middle(patch));
}

/** What the chosen stage shows on picture i: 0 is the reference, the others are targets, which are shown smaller. */
function drawOverlay(context, i) {
  const { views, solved: { on, targets, best, pose }, patch, shown } = state, target = targets[i ? i - 1 : shown];
  const rows = targets.map(({ sim }) => sim.subarray(patch * PATCHES, (patch + 1) * PATCHES)), size = i ? 1.8 : 1;
  const isOn = i ? target.on : on, v = target.forth[patch];
  if (stageIs("saliency")) drawMap(context, views[i].saliency.map((value, u) => (isOn[u] ? value : NaN)), 0, 0.5);
  if (stageIs("similarity") && i) drawMap(context, rows[i - 1], Math.min(...rows.map((row) => Math.min(...row))), 1);
  // Distances of 8 patches and more look alike.
  if (stageIs("cycle") && !i) drawMap(context, target.distances.map((d) => -d), -8, 0);
  if (stageIs("pose") && pose && i) {
    context.fillStyle = MARKS.wrong[1];
    for (const u of views[0].solid) {
      const pixel = project(toCamera(apply(pose, views[0].points[u]), targets[best], target), target);
      context.fillRect(...pixel.map((one) => one * CANVAS / CROP - 3), 6, 6);
    }
  }
  if (stageIs("matches", "view")) {
    for (const match of target.matches) drawMark(context, match[i ? 1 : 0], truthOf(target, ...match), 22 * size);
  } else if (!stageIs("pose")) {
    drawMark(context, i ? v : patch, i ? truthOf(target, patch, v) : "u", 34 * size);
    if (!i) drawMark(context, target.back[v], "back", 28);
  }
}

/** Lines between the reference and a target: its matches, the inliers of the pose, or the way of u there and back. */
function drawLines() {
  const { solved: { targets, best, pose }, patch, shown } = state, canvas = element("lines");
  const frame = canvas.getBoundingClientRect(), context = canvas.getContext("2d");
  const view = stageIs("pose") ? best : shown, { matches, forth, back } = targets[view], v = forth[patch];
  const place = (i, one) => {
    const { left, top, width } = all(".image canvas")[i].getBoundingClientRect();
    return middle(one).map((pixel, axis) => pixel * width / CANVAS + (axis ? top - frame.top : left - frame.left));
  };
  const drawn = matches.filter((_, i) => stageIs("matches", "view") || (stageIs("pose") && pose?.inliers[i]));
  const lines = drawn.map((match) => [...match, MARKS[truthOf(targets[view], ...match)][1]]);
  if (stageIs("cycle")) lines.push([patch, v, "white"], [back[v], v, "yellow"]);
  Object.assign(canvas, { width: frame.width, height: frame.height });
  for (const [from, to, strokeStyle] of lines) {
    Object.assign(context, { strokeStyle, lineWidth: 2, shadowBlur: 2, shadowColor: "black" }).beginPath();
    context.moveTo(...place(0, from));
    context.lineTo(...place(view + 1, to));
    context.stroke();
  }
}

/**
 * Both objects in the camera of the chosen view, turned by the angles `state.turn`, without perspective. The target's
 * root mean square distance from its centre is a quarter of the canvas.
 */
function drawCloud() {
  const { views, solved: { targets, best, pose } } = state, context = element("cloud").getContext("2d");
  context.clearRect(0, 0, CANVAS, CANVAS);
  if (!pose) return;
  const inBest = (target) => target.solid.map((v) => toCamera(target.points[v], target, targets[best]));
  const object = targets.flatMap(inBest), posed = views[0].solid.map((u) => apply(pose, views[0].points[u]));
  const middle3 = centroid(object), [[a, b], [c, d]] = state.turn.map((angle) => [Math.cos(angle), Math.sin(angle)]);
  const unit = CANVAS / 4 / Math.sqrt(mean(object.map((y) => dot(minus(y, middle3), minus(y, middle3)))));
  for (const [points, colour] of [[object, MARKS.right[1]], [posed, MARKS.wrong[1]]]) {
    context.fillStyle = colour;
    for (const [x, y, z] of points.map((point) => minus(point, middle3))) {
      context.fillRect(CANVAS / 2 + unit * (a * x + b * z), CANVAS / 2 + unit * (c * y - d * (a * z - b * x)), 4, 4);
    }
  }
}

/** The view of one's own photograph: keys and saliency of the network, no depth. */
async function photograph(file) {
  const picture = create("canvas", { width: CROP, height: CROP });
  const context = Object.assign(picture.getContext("2d"), { imageSmoothingQuality: "high" }), size = CROP * CROP;
  context.drawImage(await createImageBitmap(file), 0, 0, CROP, CROP);
  const { data } = context.getImageData(0, 0, CROP, CROP); // red, green, blue, opacity
  const image = Float32Array.from({ length: 3 * size }, (_, i) => data[4 * (i % size) + Math.floor(i / size)] / 255);
  const { keys, saliency } = await state.network.run({ image: new ort.Tensor("float32", image, [1, 3, CROP, CROP]) });
  return { picture, keys: keys.data, saliency: saliency.data };
}

async function openPhotographs(files) {
  if (!DATA.runtime) return; // the notice says so
  if (location.protocol === "file:") return notice("Photographs need a server; the command stands below.");
  if (files.length !== 2) return notice("Choose two pictures at once, of two objects of one kind.");
  notice("Loading the network (10 MB) and onnxruntime-web (14 MB) …");
  try {
    if (!state.network) {
      await loadScript("playground/ort.wasm.min.js");
      Object.assign(ort.env.wasm, { wasmPaths: new URL("playground/", location).href, numThreads: 1, proxy: true });
      state.network = await ort.InferenceSession.create("playground/zsp-tiny.onnx");
    }
    const views = [];
    for (const file of files) views.push(await photograph(file));
    await openViews(views);
    element("pair").selectedIndex = -1; // so that any stored pair can be chosen next
    notice("Your photographs have not left this computer. There is no pose: points in space need depth.");
  } catch (error) {
    notice(`The photographs cannot be used: ${error.message || error}`);
  }
}

function point(event) {
  const place = pointedAt(event);
  if (!place) return;
  const [column, row] = place.map((share) => inside(Math.floor(SIDE * share)));
  state.patch = row * SIDE + column;
  show();
}

function press(event) {
  const step = pressed(event), [row, column] = rowColumn(state.patch);
  if (step) state.patch = inside(row + step[0]) * SIDE + inside(column + step[1]);
  show();
}

function pressCloud(event) {
  const step = STEPS[event.key]; // columns turn about the vertical axis, rows about the horizontal one
  if (!step) return;
  event.preventDefault();
  state.turn = state.turn.map((angle, i) => angle + 0.1 * step[1 - i]);
  show();
}

function turn({ buttons, movementX, movementY }) {
  if (buttons) state.turn = [state.turn[0] + movementX / 100, state.turn[1] + movementY / 100];
  show();
}

function change() {
  if (!state.solved) return; // a pair is being opened
  state.solved = solveViews(state.views, settings());
  show();
}

/** Add four copies of an element, one for each of the other target views. */
function repeat(one) {
  for (let i = 0; i < 4; i++) one.before(one.cloneNode(true));
}

async function start() {
  repeat(all(".views figure")[0]);
  repeat(all("#scores button")[0]);
  try { await loadScript("playground/data.js"); } catch { return; } // the notice says what is missing
  state.draws = await unpack(DATA.draws, Uint32Array);
  element("pair").append(...DATA.titles.map((title, i) => new Option(title, i, false, i === FIRST_PAIR)));
  await openStored(FIRST_PAIR);
  Object.assign(element("reference"), { onpointermove: point, onpointerdown: point, onclick: point, onkeydown: press });
  Object.assign(element("cloud"), { onpointermove: turn, onkeydown: pressCloud });
  element("stages").oninput = change;
  all("#scores button").forEach((button, i) => { button.onclick = () => show(i); });
  element("pair").onchange = (event) => openStored(Number(event.target.value));
  element("files").onchange = (event) => openPhotographs(event.target.files);
  document.ondragover = (event) => event.preventDefault();
  document.ondrop = (event) => { event.preventDefault(); openPhotographs(event.dataTransfer.files); };
  window.onresize = () => show();
}

start();
