// The method of Goodwin et al. (ECCV 2022) on typed arrays, after zsp_lite; equations are those of the paper. u is a
// patch of the reference, v a patch of a target view, both numbered row by row; x and y are points in camera frames.
"use strict";

const SIDE = 28, PATCHES = SIDE * SIDE, ORTHOGONAL = Math.SQRT2; // ORTHOGONAL: distance of orthogonal unit vectors
const rowColumn = (patch) => [Math.floor(patch / SIDE), patch % SIDE];
// Limits of the scale, and of the second singular value relative to the first, as in zsp_lite/alignment.py.
const SCALES = [0.2, 5], COLLINEAR = 1e-6, IDENTITY = [[1, 0, 0], [0, 1, 0], [0, 0, 1]];

// ---- Similarity: sec. 4.1, and the algebra in the docstring of zsp_lite/matching.py ----

/** The row or column i, clamped to the grid. */
const inside = (i) => Math.min(SIDE - 1, Math.max(0, i));

/** For each patch the patch `step` away along an axis ("row" or "column"), clamped at the border. */
function moved(step, axis) {
  return Int32Array.from({ length: PATCHES }, (_, patch) => {
    const [row, column] = rowColumn(patch);
    return axis === "row" ? inside(row + step) * SIDE + column : row * SIDE + inside(column + step);
  });
}

/** S: the products of all keys (PATCHES, axes) of two images, four at a time. */
function keyProducts(keys1, keys2) {
  const axes = keys1.length / PATCHES, products = new Float32Array(PATCHES * PATCHES);
  for (let u = 0, to = 0; u < PATCHES; u++) {
    for (let v = 0; v < PATCHES; v += 4) {
      let a = 0, b = 0, c = 0, d = 0;
      for (let i = u * axes, j = v * axes; i < (u + 1) * axes; i++, j++) {
        a += keys1[i] * keys2[j];
        b += keys1[i] * keys2[j + axes];
        c += keys1[i] * keys2[j + 2 * axes];
        d += keys1[i] * keys2[j + 3 * axes];
      }
      for (const product of [a, b, c, d]) products[to++] = product;
    }
  }
  return products;
}

/** J_s: the sum of S(u + s i, v + s i) over i = -1, 0, 1, where both patches move along one axis. */
function jointShifts(matrix, step, axis) {
  const before = moved(-step, axis), after = moved(step, axis);
  return matrix.map((value, i) => {
    const u = Math.floor(i / PATCHES), v = i % PATCHES;
    return value + matrix[before[u] * PATCHES + before[v]] + matrix[after[u] * PATCHES + after[v]];
  });
}

/** Average keys (PATCHES, axes) over patches and their neighbours inside the image, along one axis of the image. */
function averaged(keys, axis) {
  const axes = keys.length / PATCHES, before = moved(-1, axis), after = moved(1, axis);
  return keys.map((value, i) => {
    const u = Math.floor(i / axes), sum = keys[i + (before[u] - u) * axes] + keys[i + (after[u] - u) * axes];
    // At the border one of the two neighbours is u itself, and counts once.
    return before[u] === u || after[u] === u ? sum / 2 : (sum + value) / 3;
  });
}

/** Add to the keys of an image what similarities need: pooled keys, and squared lengths of keys and descriptors. */
function describe(keys) {
  const pooled = averaged(averaged(keys, "row"), "column");
  const squared = squaredLengths(keys), squaredPooled = squaredLengths(pooled);
  const near = shiftSum(shiftSum(squared, 1, "row"), 1, "column");
  const far = shiftSum(shiftSum(squaredPooled, 3, "row"), 3, "column");
  return { keys, pooled, squared, squaredBinned: withoutCentre(near, far, squaredPooled) };
}

/** The sum over 9 near bins and 8 far ones: the 9 far ones without the centre. */
const withoutCentre = (near, far, centre) => near.map((value, i) => value + far[i] - centre[i]);

function squaredLengths(keys) {
  const axes = keys.length / PATCHES, squared = new Float64Array(PATCHES);
  for (let i = 0; i < keys.length; i++) squared[Math.floor(i / axes)] += keys[i] ** 2;
  return squared;
}

function shiftSum(values, step, axis) {
  const before = moved(-step, axis), after = moved(step, axis);
  return values.map((value, u) => value + values[before[u]] + values[after[u]]);
}

/** Divide products by the lengths of both vectors. */
function cosines(products, squared1, squared2) {
  return products.map((value, i) => value / Math.sqrt(squared1[Math.floor(i / PATCHES)] * squared2[i % PATCHES]));
}

/** Cosine similarities (PATCHES, PATCHES) of the keys of two images (see `describe`) and of their descriptors. */
function similarities(one, other) {
  const products = keyProducts(one.keys, other.keys), pooled = keyProducts(one.pooled, other.pooled);
  // The products of log-binned descriptors are J_1 J_1' S + (J_3 J_3' - 1) P S; P S are products of pooled keys.
  const near = jointShifts(jointShifts(products, 1, "row"), 1, "column");
  const far = jointShifts(jointShifts(pooled, 3, "row"), 3, "column");
  return {
    keys: cosines(products, one.squared, other.squared),
    descriptors: cosines(withoutCentre(near, far, pooled), one.squaredBinned, other.squaredBinned),
  };
}

// ---- Cycles and matches: eq. 2, and the supplement, "Number and diversity of correspondences" ----

/** Nearest neighbours: v of each u (forth), and u' of each v (back). */
function nearestNeighbours(sim) {
  const forth = new Int32Array(PATCHES), back = new Int32Array(PATCHES);
  for (let u = 0, i = 0; u < PATCHES; u++) {
    for (let v = 0; v < PATCHES; v++, i++) {
      if (sim[i] > sim[u * PATCHES + forth[u]]) forth[u] = v;
      if (sim[i] > sim[back[v] * PATCHES + v]) back[v] = u;
    }
  }
  return { sim, forth, back };
}

/** d(u, u') of eq. 2 for every u; infinite if u, v or u' is not foreground. */
function cyclicalDistances({ forth, back }, on1, on2) {
  return Float64Array.from(forth, (v, u) => {
    const [[row1, column1], [row2, column2]] = [u, back[v]].map(rowColumn);
    return on1[u] && on2[v] && on1[back[v]] ? Math.hypot(row1 - row2, column1 - column2) : Infinity;
  });
}

/** At most k matches [u, v], best first. `view` has sim, forth and back; `gram` are cosines within the reference. */
function findMatches(view, on1, on2, saliency, gram, { k, kmeans, cycle }) {
  const best = Float64Array.from(view.forth, (v, u) => view.sim[u * PATCHES + v]);
  const bySimilarity = () => best.map((value, u) => (on1[u] && on2[view.forth[u]] ? -value : Infinity));
  const cost = cycle ? cyclicalDistances(view, on1, on2) : bySimilarity();
  let order = [...cost.keys()].filter((u) => cost[u] < Infinity);
  order.sort((a, b) => cost[a] - cost[b] || best[b] - best[a] || a - b);
  order = order.slice(0, kmeans ? 2 * k : k);
  if (kmeans && order.length > k) {
    const labels = cluster(order.map((a) => order.map((b) => gram[a * PATCHES + b])), k);
    const members = [...new Set(labels)].map((label) => order.filter((_, i) => labels[i] === label));
    const leaders = new Set(members.map((set) => set[argMax(set.map((u) => saliency[u]))]));
    order = order.filter((u) => leaders.has(u));
  }
  return order.map((u) => [u, view.forth[u]]);
}

/** k-means of unit vectors given by their cosines, from starts that are far apart. Returns each vector's cluster. */
function cluster(gram, k) {
  const starts = [0];
  while (starts.length < k) starts.push(argMax(gram.map((row) => -Math.max(...starts.map((start) => row[start])))));
  let labels = gram.map((row) => argMax(starts.map((start) => row[start])));
  for (let round = 0; round < 30; round++) {
    const members = starts.map((_, label) => [...gram.keys()].filter((i) => labels[i] === label));
    // |x - m|^2 = 1 - 2 x . m + |m|^2 for a cluster's mean m. An empty cluster stays empty.
    const spread = members.map((set) => mean(set.map((i) => mean(set.map((j) => gram[i][j])))));
    const nearness = (row, set, label) => (set.length ? 2 * mean(set.map((j) => row[j])) - spread[label] : -Infinity);
    const next = gram.map((row) => argMax(members.map((set, label) => nearness(row, set, label))));
    if (next.every((label, i) => label === labels[i])) break;
    labels = next;
  }
  return labels;
}

const argMax = (values) => values.reduce((best, value, i) => value > values[best] ? i : best, 0);
const sum = (values) => values.reduce((a, b) => a + b, 0);
const mean = (values) => sum(values) / values.length;

/** Score of a view: the sum of -d over k matches (eq. 3). A missing match counts as orthogonal. */
function viewScore(sim, matches, k) {
  const distances = matches.map(([u, v]) => Math.sqrt(Math.max(2 - 2 * sim[u * PATCHES + v], 0)));
  return -sum(distances) - (k - matches.length) * ORTHOGONAL;
}

// ---- Pose: Umeyama's fit (eq. 4) in RANSAC (sec. 4.3) ----

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const times = (matrix, vector) => [dot(matrix[0], vector), dot(matrix[1], vector), dot(matrix[2], vector)];
const transpose = ([a, b, c]) => [[a[0], b[0], c[0]], [a[1], b[1], c[1]], [a[2], b[2], c[2]]];
const multiply = (A, B) => transpose(transpose(B).map((column) => times(A, column)));
const centroid = (points) => scaled(points.reduce(plus, [0, 0, 0]), 1 / points.length);
const plus = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
const scaled = (a, factor) => [factor * a[0], factor * a[1], factor * a[2]];
const minus = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
const apply = ({ scale, R, t }, x) => plus(scaled(times(R, x), scale), t);

/**
 * Eigenvalues, largest first, and eigenvectors of a symmetric 3x3 matrix by Jacobi's rotations J. Six sweeps suffice
 * for double precision; an element below 1e-17 of those on the diagonal counts as 0.
 */
function eigenvectors(matrix) {
  let a = matrix, V = IDENTITY;
  for (let sweep = 0; sweep < 6; sweep++) {
    for (const [p, q] of [[0, 1], [0, 2], [1, 2]]) {
      if (a[p][q] ** 2 <= 1e-34 * Math.abs(a[p][p] * a[q][q])) continue;
      const slope = (a[q][q] - a[p][p]) / (2 * a[p][q]), J = IDENTITY.map((row) => [...row]);
      const tangent = Math.sign(slope || 1) / (Math.abs(slope) + Math.hypot(slope, 1)), c = 1 / Math.hypot(tangent, 1);
      [J[p][p], J[p][q], J[q][p], J[q][q]] = [c, tangent * c, -tangent * c, c];
      [a, V] = [multiply(transpose(J), multiply(a, J)), multiply(V, J)];
    }
  }
  const order = [0, 1, 2].sort((i, j) => a[j][j] - a[i][i]);
  return { values: order.map((i) => a[i][i]), vectors: order.map((i) => transpose(V)[i]) };
}

/** The similarity that minimises sum |y - (scale R x + t)|^2, never a mirror (eq. 4; Umeyama 1991); null for a line. */
function umeyama(x, y, scales = [0, Infinity]) {
  const meanX = centroid(x), meanY = centroid(y), C = [[0, 0, 0], [0, 0, 0], [0, 0, 0]];
  let variance = 0;
  x.forEach((point, n) => {
    const x0 = minus(point, meanX), y0 = minus(y[n], meanY);
    variance += dot(x0, x0);
    C.forEach((row, i) => row.forEach((_, j) => { row[j] += y0[i] * x0[j]; }));
  });
  // C = U D V': rows v of V are eigenvectors of C'C, and u = C v / d. The third axes close right-handed frames.
  const { values, vectors: V } = eigenvectors(multiply(transpose(C), C));
  const d = values.map((value) => Math.sqrt(Math.max(value, 0)));
  if (!(d[1] > COLLINEAR * d[0])) return null;
  const U = [0, 1].map((i) => scaled(times(C, V[i]), 1 / d[i]));
  U[2] = cross(U[0], U[1]);
  V[2] = cross(V[0], V[1]);
  const trace = d[0] + d[1] + dot(U[2], times(C, V[2]));
  const scale = Math.min(scales[1], Math.max(scales[0], trace / variance)), R = multiply(transpose(U), V);
  return { scale, R, t: minus(meanY, scaled(times(R, meanX), scale)) };
}

/** Samples of 4 different matches out of n, from the numbers that NumPy draws for the same seed (Lemire 2019). */
function drawSamples(n, trials, draws) {
  let next = 0;
  const below = (limit) => {
    let product = draws[next++] * limit;
    while (product % 2 ** 32 < 2 ** 32 % limit) product = draws[next++] * limit;
    return Math.floor(product / 2 ** 32);
  };
  const samples = Array.from({ length: trials }, () => []);
  for (let size = 0; size < 4; size++) {
    for (const sample of samples) {
      let index = below(n - size); // a rank among the indices that are not in the sample
      for (const earlier of [...sample].sort((a, b) => a - b)) if (index >= earlier) index++;
      sample.push(index);
    }
  }
  return samples;
}

/** The fit with the most inliers (of equal ones, the closest), fitted again to these; null if there is none. */
function ransac(x, y, trials, threshold, draws) {
  let best = null;
  if (x.length < 4) return null;
  for (const sample of drawSamples(x.length, trials, draws)) {
    const fit = umeyama(sample.map((i) => x[i]), sample.map((i) => y[i]));
    if (!fit || fit.scale < SCALES[0] || fit.scale > SCALES[1]) continue;
    let count = 0, total = 0;
    const inliers = x.map((point, i) => {
      const rest = minus(y[i], apply(fit, point)), residual = Math.sqrt(dot(rest, rest));
      count += residual < threshold;
      total += residual < threshold ? residual : 0;
      return residual < threshold;
    });
    const isBetter = !best || count > best.count || (count === best.count && total < best.total);
    if (isBetter) best = { fit, inliers, count, total };
  }
  if (!best) return null;
  const [chosenX, chosenY] = [x, y].map((points) => points.filter((_, i) => best.inliers[i]));
  const refined = best.count >= 3 ? umeyama(chosenX, chosenY, SCALES) : null;
  return { ...(refined || best.fit), inliers: best.inliers };
}

/** The angle between two rotations in degrees. */
function rotationError(R1, R2) {
  const [a, b, c] = multiply(transpose(R1), R2), twiceSine = Math.hypot(c[1] - b[2], a[2] - c[0], b[0] - a[1]);
  return Math.atan2(twiceSine, a[0] + b[1] + c[2] - 1) * 180 / Math.PI;
}

/** Carry a point from the camera of one target view to that of another (sec. 5.6). */
const toCamera = (y, from, to) => plus(times(to.R, times(transpose(from.R), minus(y, from.t))), to.t);

/** Pixel of a camera point. */
const project = (y, { focal_length: focal, principal_point: centre }) => [0, 1].map((i) => focal[i] * y[i] / y[2] + centre[i]);
