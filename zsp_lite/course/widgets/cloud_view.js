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
  let points, colours, crosses, view, zoom, pan, side, unit, ratio, n, depth, scheduled = false, held = null;

  const project = (p) => {
    const at = [0, 3, 6].map((i) => view[i] * p[0] + view[i + 1] * p[1] + view[i + 2] * p[2]);
    return [side / 2 + pan[0] + at[0] * unit, side / 2 + pan[1] + at[1] * unit, at[2]];
  };
  // For browser tests: the position of a point on the canvas in CSS pixels, and the number of points.
  canvas.pointOnCanvas = (index) => project(points.subarray(3 * index, 3 * index + 3)).slice(0, 2);

  function updatePoints() {
    points = new Float32Array(bytes(model.get("points")).slice().buffer);
    colours = bytes(model.get("colours"));
    crosses = bytes(model.get("crosses"));
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
    ratio = window.devicePixelRatio || 1;
    n = Math.round(side * ratio);
    if (canvas.width !== n) canvas.width = canvas.height = n;
    canvas.style.width = canvas.style.height = `${side}px`;
    drawSpots();
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    for (const [p, q] of model.get("lines") ?? []) {
      outlined(`M${project(p).slice(0, 2)}L${project(q).slice(0, 2)}`, [2, 1], "#D55E00");
    }
    model.get("marks").forEach((at, i) => drawMark(at, i + 1));
    const cursor = model.get("cursor");
    if (cursor.length) {
      const [x, y] = project(cursor);
      outlined(`M${x - 14} ${y}h9m10 0h9M${x} ${y - 14}v9m0 10v9`, [5, 2]);
    }
    canvas.dataset.marks = model.get("marks").length;
    canvas.dataset.cursor = cursor.join(" ");
    canvas.setAttribute("aria-label", model.get("alt"));
  }

  // Draw the points with hidden ones removed, paler with depth; keep the depth of every pixel.
  function drawSpots() {
    depth = new Float32Array(n * n).fill(Infinity);
    const picture = pen.createImageData(n, n);
    const pixels = new Uint32Array(picture.data.buffer).fill(0xffffffff);
    const reach = Math.max(1, Math.round((SPOT * unit * ratio) / 2));
    for (let i = 0; i < points.length; i += 3) {
      const [x, y, z] = project(points.subarray(i, i + 3));
      const [column, row] = [Math.round(x * ratio), Math.round(y * ratio)];
      const pale = clamp(0.15 + 0.3 * z, 0, 0.45);
      const [r, g, b] = [0, 1, 2].map((k) => colours[i + k] + pale * (255 - colours[i + k]));
      const colour = (255 << 24) | (b << 16) | (g << 8) | r;
      const cross = crosses[i / 3];
      const arm = cross ? reach + 1 : reach;
      for (let v = Math.max(row - arm, 0); v <= Math.min(row + arm, n - 1); v++) {
        for (let u = Math.max(column - arm, 0); u <= Math.min(column + arm, n - 1); u++) {
          const [du, dv] = [Math.abs(u - column), Math.abs(v - row)];
          if (cross ? Math.abs(du - dv) > 0.5 * ratio : du * du + dv * dv > reach * (reach + 1)) continue;
          if (z < depth[v * n + u]) [depth[v * n + u], pixels[v * n + u]] = [z, colour];
        }
      }
    }
    pen.putImageData(picture, 0, 0);
  }

  // Draw a path, in SVG's words, with a white outline.
  function outlined(path, widths, colour = "black") {
    for (const [k, strokeStyle] of ["white", colour].entries()) {
      Object.assign(pen, { strokeStyle, lineWidth: widths[k] });
      pen.stroke(new Path2D(path));
    }
  }

  // Draw a number in a disc beside its point; the outline is dashed where the cloud hides the point.
  function drawMark(at, number) {
    const [x, y, z] = project(at);
    const pixel = clamp(Math.round(y * ratio), 0, n - 1) * n + clamp(Math.round(x * ratio), 0, n - 1);
    const hidden = z > depth[pixel] + 0.12;
    const [left, top] = [clamp(x + 15, 10, side - 10), clamp(y - 15, 10, side - 10)];
    pen.globalAlpha = hidden ? 0.6 : 1;
    pen.setLineDash(hidden ? [3, 2] : []);
    outlined(`M${x} ${y}L${left} ${top}M${x + 3.5} ${y}a3.5 3.5 0 1 0-7 0a3.5 3.5 0 1 0 7 0`, [4, 1.5]);
    pen.beginPath();
    pen.arc(left, top, 9, 0, 7);
    pen.fillStyle = "white";
    pen.fill();
    pen.stroke();
    pen.setLineDash([]);
    pen.fillStyle = "black";
    pen.font = "bold 12px sans-serif";
    [pen.textAlign, pen.textBaseline] = ["center", "middle"];
    pen.fillText(number, left, top + 0.5);
    pen.globalAlpha = 1;
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

  function zoomBy(factor, x, y) {
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
    const still = !held.moved;
    held = null;
    if (!still) return model.save_changes();
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
    const by = { ArrowLeft: [-0.12, 0], ArrowRight: [0.12, 0], ArrowUp: [0, -0.12], ArrowDown: [0, 0.12] }[event.key];
    if (by) {
      turn(...by);
      model.save_changes();
    } else if (event.key === "+" || event.key === "-") zoomBy(event.key === "+" ? 1.2 : 1 / 1.2, side / 2, side / 2);
    else return;
    event.preventDefault();
    event.stopPropagation();
    schedule();
  });

  model.on("change:points change:colours change:crosses", updatePoints);
  model.on("change:view", () => { if (!held) { view = model.get("view"); schedule(); } });
  model.on("change:view_resets", resetView);
  model.on("change:marks change:cursor change:alt change:side", schedule);
  updatePoints();
  resetView();
}

// Show clouds that a page stores, beside each other: they turn together.
function stored(el, { panels, legend, alt }) {
  const listeners = [];
  const redraw = () => listeners.forEach((listener) => listener());
  const decoded = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt());
  let view = [1, 0, 0, 0, 1, 0, 0, 0, 1];
  for (const { title, points, colours, lines } of panels) {
    const box = el.appendChild(document.createElement("figure"));
    box.append(title);
    const state = {
      points: Float32Array.from(new Int16Array(decoded(points).buffer), (x) => x / 8192),
      colours: decoded(colours), crosses: [], marks: [], cursor: [], lines, alt: `${title}: ${alt}`,
    };
    const get = (name) => ({ ...state, view, side: box.clientWidth - 2 })[name];
    const set = (_, value) => { view = value; redraw(); };
    const on = (name, listener) => { if (name === "change:view") listeners.push(listener); };
    render({ el: box, model: { get, set, on, save_changes() {}, send() {} } });
  }
  el.insertAdjacentHTML("beforeend", legend);
  new ResizeObserver(redraw).observe(el);
}

export default { render };
