// A point cloud on a plain canvas: drag rotates, the wheel zooms, shift and drag pans, a click is sent to Python.
// No WebGL and no network. Lengths are in view units: the cloud fills the unit ball; depth increases away from the viewer.

const FILL = 0.46; // length of a view unit, as a fraction of the side of the canvas
const SPOT = 0.034; // diameter of a point, in view units
const SLACK = 4; // largest movement within a click, in pixels

const clamp = (x, low, high) => Math.min(Math.max(x, low), high);

const bytes = (data) => new Uint8Array(data.buffer, data.byteOffset, data.byteLength);

function render({ model, el }) {
  const canvas = document.createElement("canvas");
  canvas.className = "zsp-cloud";
  canvas.tabIndex = 0;
  canvas.setAttribute("role", "img");
  el.append(canvas);
  const pen = canvas.getContext("2d");
  let points, colours, view, zoom, pan, side, unit, scheduled = false, held = null;

  const project = (p) => {
    const at = [0, 3, 6].map((i) => view[i] * p[0] + view[i + 1] * p[1] + view[i + 2] * p[2]);
    return [side / 2 + pan[0] + at[0] * unit, side / 2 + pan[1] + at[1] * unit, at[2]];
  };
  // For browser tests: the position of a point on the canvas in CSS pixels, and the number of points.
  canvas.pointOnCanvas = (index) => project(points.subarray(3 * index, 3 * index + 3)).slice(0, 2);

  function updatePoints() {
    points = new Float32Array(bytes(model.get("points")).slice().buffer);
    colours = bytes(model.get("colours"));
    canvas.dataset.points = points.length / 3;
    schedule();
  }

  function resetView() {
    view = model.get("view");
    [zoom, pan] = [1, [0, 0]];
    schedule();
  }

  function schedule() {
    if (!scheduled) requestAnimationFrame(draw);
    scheduled = true;
  }

  function draw() {
    scheduled = false;
    side = model.get("side");
    unit = side * FILL * zoom;
    const ratio = window.devicePixelRatio || 1;
    canvas.width = canvas.height = side * ratio; // also clears it
    canvas.style.width = canvas.style.height = `${side}px`;
    pen.scale(ratio, ratio);
    drawSpots();
    for (const ends of model.get("lines") ?? []) {
      outlined("M" + ends.map((end) => project(end).slice(0, 2)).join("L"), [2, 1], "#D55E00");
    }
    model.get("marks").forEach(drawMark);
    canvas.dataset.marks = model.get("marks").length;
    canvas.setAttribute("aria-label", model.get("alt"));
  }

  // Draw the points, far ones first, paler with depth.
  function drawSpots() {
    const spots = [];
    for (let i = 0; i < points.length; i += 3) spots.push([...project(points.subarray(i, i + 3)), i]);
    spots.sort((a, b) => b[2] - a[2]);
    const radius = Math.max(1, (SPOT * unit) / 2);
    Object.assign(pen, { font: `${5 * radius}px sans-serif`, textAlign: "center", textBaseline: "middle" });
    for (const [x, y, z, i] of spots) {
      const pale = clamp(0.15 + 0.3 * z, 0, 0.45);
      pen.fillStyle = `rgb(${[0, 1, 2].map((k) => colours[i + k] + pale * (255 - colours[i + k]))})`;
      pen.beginPath();
      if (i / 3 < model.get("discs")) pen.arc(x, y, radius, 0, 7);
      else pen.fillText("×", x, y);
      pen.fill();
    }
  }

  // Draw a path, in SVG's words, with a white outline.
  function outlined(path, widths, colour = "black") {
    for (const [k, strokeStyle] of ["white", colour].entries()) {
      Object.assign(pen, { strokeStyle, lineWidth: widths[k] });
      pen.stroke(new Path2D(path));
    }
  }

  // Draw a number in a disc beside its point.
  function drawMark(at, index) {
    const [x, y] = project(at);
    const [left, top] = [clamp(x + 15, 10, side - 10), clamp(y - 15, 10, side - 10)];
    outlined(`M${x} ${y}L${left} ${top}M${x + 3.5} ${y}a3.5 3.5 0 1 0-7 0a3.5 3.5 0 1 0 7 0`, [4, 1.5]);
    pen.beginPath();
    pen.arc(left, top, 9, 0, 7);
    pen.fillStyle = "white";
    pen.fill();
    pen.stroke();
    Object.assign(pen, { fillStyle: "black", font: "bold 12px sans-serif" });
    pen.fillText(index + 1, left, top + 0.5);
  }

  // Rotate the view by angles about the vertical axis of the screen, then about the horizontal one.
  function turn(...angles) {
    view = [...view];
    for (const [i, angle] of angles.entries()) {
      for (const k of [0, 1, 2]) {
        const [a, b, c, s] = [view[3 * i + k], view[6 + k], Math.cos(angle), Math.sin(angle)];
        [view[3 * i + k], view[6 + k]] = [c * a - s * b, s * a + c * b];
      }
    }
    model.set("view", view);
  }

  function zoomBy(factor, x = side / 2, y = x) {
    const next = clamp(zoom * factor, 0.4, 20);
    pan = pan.map((p, k) => p + ([x, y][k] - side / 2 - p) * (1 - next / zoom));
    zoom = next;
    schedule();
  }

  canvas.addEventListener("pointerdown", (event) => {
    if (event.button) return;
    canvas.focus({ preventScroll: true });
    canvas.setPointerCapture(event.pointerId);
    held = { x: event.offsetX, y: event.offsetY, moved: false };
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!held) return;
    const [dx, dy] = [event.offsetX - held.x, event.offsetY - held.y];
    if (!held.moved && Math.hypot(dx, dy) < SLACK) return;
    held = { x: event.offsetX, y: event.offsetY, moved: true };
    if (event.shiftKey) pan = [pan[0] + dx, pan[1] + dy];
    else turn((2.4 * dx) / side, (2.4 * dy) / side);
    schedule();
  });
  canvas.addEventListener("pointerup", (event) => {
    if (!held) return;
    const { moved } = held;
    held = null;
    if (moved) return model.save_changes();
    const at = [event.offsetX, event.offsetY].map((x, k) => (x - side / 2 - pan[k]) / unit);
    model.send({ at, view, reach: 9 / unit });
  });
  canvas.addEventListener("pointercancel", () => (held = null));
  canvas.addEventListener("dblclick", (event) => event.preventDefault());
  // Zoom only if the canvas has the focus, so that the page still scrolls.
  canvas.addEventListener("wheel", (event) => {
    if (document.activeElement !== canvas) return;
    event.preventDefault();
    zoomBy(Math.exp(-clamp(event.deltaY, -100, 100) * 0.002), event.offsetX, event.offsetY);
  }, { passive: false });
  canvas.addEventListener("keydown", (event) => {
    const act = {
      ArrowLeft: () => turn(-0.12, 0), ArrowRight: () => turn(0.12, 0), "+": () => zoomBy(1.2),
      ArrowUp: () => turn(0, -0.12), ArrowDown: () => turn(0, 0.12), "-": () => zoomBy(1 / 1.2),
    }[event.key];
    if (!act) return;
    act();
    model.save_changes();
    event.preventDefault();
    event.stopPropagation();
    schedule();
  });

  model.on("change:points change:colours change:discs", updatePoints);
  model.on("change:view", () => { if (!held) { view = model.get("view"); schedule(); } });
  model.on("change:view_resets", resetView);
  model.on("change:marks change:alt change:side", schedule);
  updatePoints();
  resetView();
}

const STYLE = `<style>
.zsp-turning { display: flex; flex-wrap: wrap; gap: 6px 16px; font-size: 14px; line-height: 1.4; }
.zsp-turning figure { flex: 1 1 260px; max-width: 360px; min-width: 0; margin: 0; padding: 0; }
.zsp-turning p { flex: 1 0 100%; margin: 0; }
.zsp-turning b { padding: 0 1.5em; margin-right: 0.5em; background: linear-gradient(90deg, #fde725, #21918c, #440154); }
.zsp-turning canvas { display: block; border: 1px solid #888; background: white; cursor: grab; touch-action: pan-y; }
</style>`;

// Show clouds that a page stores, beside each other: they turn together.
function stored(el, panels, alt) {
  const listeners = [];
  const redraw = () => listeners.forEach((listener) => listener());
  const decoded = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt());
  let view = [1, 0, 0, 0, 1, 0, 0, 0, 1];
  for (const [title, points, colours, lines] of panels) {
    const box = el.appendChild(document.createElement("figure"));
    box.append(title);
    const state = {
      points: Float32Array.from(new Int16Array(decoded(points).buffer), (x) => x / 8192),
      colours: decoded(colours), discs: Infinity, marks: [], lines, alt: `${title}: ${alt}`,
    };
    const get = (name) => ({ ...state, view, side: box.clientWidth - 2 })[name];
    const set = (_, value) => { view = value; redraw(); };
    const on = (name, listener) => { if (name === "change:view") listeners.push(listener); };
    render({ el: box, model: { get, set, on, save_changes() {}, send() {} } });
  }
  el.insertAdjacentHTML("beforeend", `${STYLE}<p><b></b>${alt}</p>`);
  new ResizeObserver(redraw).observe(el);
}

export default { render };
