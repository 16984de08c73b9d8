import assert from "node:assert/strict";
import test from "node:test";

import { load } from "./page.mjs";

const { inversePose, lookAt, multiply, perspective, poseMatrix, transform } = await load("matrix.js");
const { NO_RAY, maxRadius, project, rayTable, unprojector } = await load("lens.js");
const { eyeOf, home, panned, projectionMatrix, quantile, turned, viewMatrix, zoomed } = await load("orbit.js");
const { FEWEST_POINTS, MOST_POINTS, TARGET_MS, Thinning, cloudWidth, thinGrid } = await load("thinning.js");
const { floorLines, frustumLines, samplePoints, upOf } = await load("cloudscene.js");
const { cloudHint } = await load("cloudhints.js");
const { sourcesOf } = await load("cloudsource.js");
const { movedByKey } = await load("cloudinput.js");
const { placeOf } = await load("cloudlabels.js");

const close = (actual, expected, tolerance, what = "") => {
  assert.equal(actual.length, expected.length, what);
  actual.forEach((value, i) => assert.ok(Math.abs(value - expected[i]) <= tolerance, `${what} ${actual} is not ${expected}`));
};

const PINHOLE = { fx: 612.3, fy: 609.8, cx: 641.7, cy: 358.2 };
const PIXELS = [[0, 0], [320, 0], [1279, 719], [640, 360], [100, 600]];

// Computed with OpenCV 5.0.0: projectPoints, undistortPoints, and those of fisheye.
const OPENCV = [
  {
    model: "none", coeffs: [],
    points: [[0.042648, -1.405737, 3.771191], [0.024541, 0.745717, 2.402175], [-2.383913, 1.245818, 3.069118]],
    shown: [[648.624436, 130.892918], [647.955354, 547.502706], [166.100844, 605.730338]],
    rays: [[-1.04801568, -0.58740571], [-0.52539605, -0.58740571], [1.04082966, 0.5916694], [-0.00277642, 0.00295179], [-0.88469704, 0.39652345]],
  },
  {
    model: "brown_conrady", coeffs: [0.11, -0.21, 0.0012, -0.0007, 0.09],
    points: [[1.341295, -0.288508, 2.748529], [0.613042, -0.102493, 1.244237], [-2.591941, 1.631545, 3.631639]],
    shown: [[944.82909, 293.423632], [947.7666, 307.403195], [201.564634, 634.449461]],
    rays: [[-1.0540406, -0.5931276], [-0.5204522, -0.58307903], [1.04957156, 0.59429694], [-0.00277637, 0.00295173], [-0.88900322, 0.39760822]],
  },
  {
    model: "rational", coeffs: [0.42, -2.51, 0.0006, -0.0003, 1.42, 0.3, -2.34, 1.35],
    points: [[1.945494, 0.176745, 3.532319], [-0.209741, -0.250606, 1.218347], [-0.327931, 0.075255, 0.466662]],
    shown: [[987.225363, 389.579245], [535.481237, 231.846283], [195.216899, 460.410863]],
    rays: [[-0.99170093, -0.55678221], [-0.50529119, -0.56544548], [0.9847855, 0.55887617], [-0.00277639, 0.00295176], [-0.83697793, 0.37476512]],
  },
  {
    model: "kannala_brandt4", coeffs: [0.02, -0.011, 0.004, -0.0009],
    points: [[0.668886, -0.317429, 2.014759], [-2.614657, 0.902895, 3.276182], [-1.557123, 0.58593, 3.279566]],
    shown: [[836.957274, 265.916326], [232.793443, 498.827339], [371.608262, 459.417889]],
    rays: [[-2.14690408, -1.20332523], [-0.66102201, -0.73903887], [2.11485642, 1.20221], [-0.00277643, 0.0029518], [-1.29906619, 0.58224475]],
  },
];

for (const { model, coeffs, points, shown, rays } of OPENCV) {
  const intrinsics = { ...PINHOLE, model, coeffs };
  test(`${model}: points and pixels agree with OpenCV`, () => {
    points.forEach((point, i) => close(project(intrinsics, point), shown[i], 1e-5, "pixel"));
    const unproject = unprojector(intrinsics);
    PIXELS.forEach(([u, v], i) => close(unproject(u, v), rays[i], 2e-8, "ray"));
  });
}

test("inverse Brown-Conrady agrees with librealsense, and its inverse with it", () => {
  const intrinsics = { ...PINHOLE, model: "inverse_brown_conrady", coeffs: [0.06, -0.05, 0.0011, -0.0008, 0.02] };
  // pyrealsense2: rs2_project_point_to_pixel, in single precision.
  const points = [[0.3, -0.2, 1.1], [-0.9, 0.5, 1.7], [1.2, 0.7, 2], [0.01, -0.02, 0.9]];
  const shown = [[809.4812, 246.83969], [311.58819, 540.99329], [1015.95569, 576.08539], [648.50287, 344.64972]];
  const unproject = unprojector(intrinsics);
  points.forEach((point, i) => {
    close(project(intrinsics, point), shown[i], 1e-3, "pixel");
    close(unproject(...project(intrinsics, point)), [point[0] / point[2], point[1] / point[2]], 1e-8, "ray");
  });
});

test("nothing is projected from behind a camera or from beyond its lens model", () => {
  const intrinsics = { ...PINHOLE, model: "brown_conrady", coeffs: [-0.3, 0, 0, 0, 0] };
  // r (1 - 0.3 r²) grows up to r = 1 / sqrt(0.9).
  assert.ok(Math.abs(maxRadius(intrinsics) - 1 / Math.sqrt(0.9)) < 0.011);
  assert.equal(project(intrinsics, [0, 0, -1]), null);
  assert.equal(project(intrinsics, [3, 0, 1]), null);
  assert.equal(unprojector(intrinsics)(PINHOLE.cx + 3 * PINHOLE.fx, 0), null);
});

test("a table of rays has every step-th pixel of the full image, from the first", () => {
  const intrinsics = { fx: 100, fy: 50, cx: 4, cy: 2, model: "none", coeffs: [] };
  const rays = rayTable(intrinsics, 3, 2, 4);
  close([...rays], [-0.04, -0.04, 0, -0.04, 0.04, -0.04, -0.04, 0.04, 0, 0.04, 0.04, 0.04], 1e-7);
  const folded = rayTable({ ...intrinsics, model: "brown_conrady", coeffs: [-30, 0, 0, 0, 0] }, 2, 1, 4000);
  assert.deepEqual([folded[2], folded[3]], [NO_RAY, NO_RAY]);
});

test("a pose turns and moves as its quaternion says, and its inverse undoes it", () => {
  const half = Math.SQRT1_2;
  const quarterAboutZ = poseMatrix([0, 0, half, half], [1, 2, 3]);
  close(transform(quarterAboutZ, [1, 0, 0]), [1, 3, 3, 1], 1e-12);
  const pose = poseMatrix([-0.3, 0.5, 0.7, 0.4], [0.1, -0.2, 0.3]);
  const [x, y, z] = transform(pose, [0.7, 0.8, 0.9]);
  close(transform(inversePose(pose), [x, y, z]), [0.7, 0.8, 0.9, 1], 1e-12);
  close(multiply(pose, inversePose(pose)), [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1], 1e-12);
});

test("a view shows its target in the middle, and what is above it above", () => {
  const view = lookAt([0, 0, -2], [0, 0, 1], [0, -1, 0]);
  const whole = multiply(perspective(1, 2, 0.1, 10), view);
  const size = { width: 200, height: 100 };
  close(Object.values(placeOf(whole, [0, 0, 1], size)), [100, 50], 1e-9);
  const above = placeOf(whole, [0, -0.5, 1], size);
  assert.ok(above.y < 50 && Math.abs(above.x - 100) < 1e-9);
  const right = placeOf(whole, [0.5, 0, 1], size);
  assert.ok(right.x > 100, "x is right for one who looks along z with y down");
  assert.equal(placeOf(whole, [0, 0, -3], size), null);
});

const orbit = { target: [0, 0, 1], up: [0, -1, 0], distance: 2, yaw: 0.3, pitch: 0.2 };

test("an orbit keeps its distance while it turns and its direction while it moves", () => {
  const distance = (o) => Math.hypot(...eyeOf(o).map((value, i) => value - o.target[i]));
  let moved = orbit;
  for (let i = 0; i < 50; i++) {
    moved = turned(moved, 0.3, 0.11);
    assert.ok(Math.abs(distance(moved) - 2) < 1e-9);
    assert.ok(viewMatrix(moved).every(Number.isFinite), "also straight above");
  }
  assert.ok(Math.abs(distance(zoomed(orbit, 0.5)) - 1) < 1e-12);
  assert.ok(zoomed(orbit, 1e-9).distance > 0);
  const [, , , ...rest] = viewMatrix(panned(orbit, 0.2, 0.1));
  close(rest.slice(0, 9), viewMatrix(orbit).slice(3, 12), 1e-12);
});

test("a point under the pointer stays there when the scene is moved", () => {
  const size = { width: 300, height: 200 };
  const place = (o) => placeOf(multiply(projectionMatrix(o, 1.5), viewMatrix(o)), [0, 0, 1], size);
  const before = place(orbit);
  const after = place(panned(orbit, 0.1, -0.2));
  close([after.x - before.x, after.y - before.y], [20, -40], 1e-6);
});

test("home is behind and above the cameras and shows what they see", () => {
  const ahead = poseMatrix([0, 0, 0, 1], [0, 0, 0]);
  const points = [[-0.5, 0, 2], [0.5, 0, 2], [0, 0.4, 2], [0, -0.4, 2], [0, 0, 2]];
  const from = home([ahead], points, [0, -1, 0]);
  close(from.target, [0, 0, 2], 1e-12);
  const [, y, z] = eyeOf(from);
  assert.ok(z < 0 && y < -0.5, `${eyeOf(from)}`);
  const whole = multiply(projectionMatrix(from, 1.6), viewMatrix(from));
  for (const point of [...points, [0, 0, 0]]) {
    assert.notEqual(placeOf(whole, point, { width: 160, height: 100 }), null, `${point}`);
  }
  // Two that look at each other, and see nothing.
  const back = poseMatrix([0, 1, 0, 0], [0, 0, 3]);
  const between = home([ahead, back], [], [0, -1, 0]);
  close(between.target, [0, 0, 1.5], 1e-12);
});

test("up is where the upper edges of the images are", () => {
  const ahead = poseMatrix([0, 0, 0, 1], [0, 0, 0]);
  assert.deepEqual(upOf([ahead]), [0, -1, 0]);
  // Optical axes along x, z of the mount up: what a robot's base is.
  const robot = poseMatrix([-0.5, 0.5, -0.5, 0.5], [0, 0, 0]);
  close(transform(robot, [0, 0, 1]), [1, 0, 0, 1], 1e-12);
  assert.deepEqual(upOf([robot]), [0, 0, 1]);
  assert.deepEqual(upOf([ahead, poseMatrix([0, 0, 1, 0], [0, 0, 0])]), [0, -1, 0], "images that cancel each other");
});

test("a frustum has the corners that the lens gives", () => {
  const intrinsics = { fx: 100, fy: 100, cx: 50, cy: 25, model: "none", coeffs: [] };
  const lines = frustumLines(intrinsics, 101, 51, poseMatrix([0, 0, 0, 1], [1, 0, 0]), 2);
  assert.equal(lines.length % 6, 0);
  close(lines.slice(0, 6), [1, 0, 0, 0, -0.5, 2], 1e-12);
});

test("the floor lies across up at its height, with round cells", () => {
  const { lines, cellM } = floorLines([0, -1, 0], -1.5, [0.33, 0, 2], 1.7);
  assert.equal(cellM, 0.2);
  for (let i = 0; i < lines.length; i += 3) {
    assert.ok(Math.abs(lines[i + 1] - 1.5) < 1e-12);
  }
});

test("sampled points are where a slow model puts them, without holes", () => {
  const intrinsics = { fx: 100, fy: 100, cx: 1, cy: 1, model: "none", coeffs: [] };
  const depth = new Uint16Array([0, 1000, 2000, 0, 500, 0]);
  const pose = poseMatrix([0, 0, 0, 1], [0, 0, 10]);
  const samples = samplePoints(depth, rayTable(intrinsics, 3, 2, 1), 0.001, pose, 100);
  assert.equal(samples.length, 3);
  close(samples[1], [0.02, -0.02, 12], 1e-6);
});

test("a quantile is one of the values", () => {
  assert.equal(quantile([3, 1, 2], 0.5), 2);
  assert.equal(quantile([3, 1, 2], 1), 3);
});

/** Frames of a computer that needs `perPoint` ms for a point and `fixed` ms for a frame. */
function settle(thinning, perPoint, fixed, offered, frames = 120) {
  let ms = 0;
  for (let i = 0; i < frames; i++) {
    const points = Math.min(offered, thinning.budget);
    ms = fixed + perPoint * points;
    thinning.drawn(ms, points);
  }
  return { ms, points: Math.min(offered, thinning.budget) };
}

test("slow and fast computers come to the time of a frame that is aimed at, and stay there", () => {
  for (const [perPoint, fixed] of [[0.0008, 5], [0.0004, 20], [0.004, 0]]) {
    const thinning = new Thinning();
    const { ms } = settle(thinning, perPoint, fixed, 1e6);
    assert.ok(ms <= 1.2 * TARGET_MS && ms >= 0.7 * TARGET_MS, `${perPoint}: ${ms} ms`);
    const { budget } = thinning;
    settle(thinning, perPoint, fixed, 1e6);
    assert.equal(thinning.budget, budget);
  }
});

test("a fast computer draws all that may be drawn, a hopeless one the fewest", () => {
  assert.equal(settle(new Thinning(), 0.00001, 1, 1e6).points, MOST_POINTS);
  assert.equal(settle(new Thinning(), 1, 1, 1e6).points, FEWEST_POINTS);
});

test("one slow frame changes nothing", () => {
  const thinning = new Thinning();
  settle(thinning, 0.001, 0, 1e6);
  const { budget } = thinning;
  for (const ms of [80, 2000, 80]) {
    thinning.drawn(ms, budget);
  }
  assert.equal(thinning.budget, budget);
});

test("a chosen number of points is kept, however long a frame takes", () => {
  const thinning = new Thinning();
  thinning.setLimit(100_000);
  assert.equal(settle(thinning, 0.01, 0, 1e6).points, 100_000);
  thinning.setLimit(null);
  assert.ok(settle(thinning, 0.01, 0, 1e6).points < 10_000);
});

test("a thinned grid has at most its share of the points and reaches over the whole image", () => {
  assert.deepEqual(thinGrid(320, 180, 1), { columns: 320, rows: 180 });
  assert.deepEqual(thinGrid(320, 180, 7), { columns: 320, rows: 180 });
  for (const share of [0.9, 0.5, 0.11, 0.001]) {
    const { columns, rows } = thinGrid(320, 180, share);
    assert.ok(columns * rows <= share * 320 * 180 && columns * rows >= 0.75 * share * 320 * 180 - 40, `${share}`);
    // The shader's middle of the last cell is inside the image.
    assert.ok(Math.floor(((columns - 0.5) * 320) / columns) < 320);
  }
});

test("images are asked for as wide as the points need", () => {
  assert.equal(cloudWidth(100_000, 7), 320);
  assert.equal(cloudWidth(300_000, 7), 320);
  assert.equal(cloudWidth(300_000, 2), 640);
});

test("depth is coloured by colour, or else by another image, or by none", () => {
  const isDepth = (format) => format === "z16";
  const stream = (id, format, samples_hz = null) => ({ id, format, samples_hz });
  const cameras = [
    { name: "a", streams: [stream("a/ir_left", "gray8"), stream("a/color", "rgb8"), stream("a/depth", "z16"), stream("a/depth_refined", "z16")] },
    { name: "b", streams: [stream("b/imu", "", 200), stream("b/depth", "z16"), stream("b/ir", "gray8")] },
    { name: "c", streams: [stream("c/depth", "z16")] },
    { name: "d", streams: [stream("d/color", "rgb8")] },
  ];
  assert.deepEqual(sourcesOf(cameras, isDepth).map(({ id, colorId }) => [id, colorId]), [
    ["a/depth", "a/color"], ["a/depth_refined", "a/color"], ["b/depth", "b/ir"], ["c/depth", null],
  ]);
});

test("keys of the view turn, move and zoom; others are left alone", () => {
  assert.ok(movedByKey(orbit, "ArrowLeft", false).yaw > orbit.yaw);
  assert.ok(movedByKey(orbit, "ArrowUp", false).pitch > orbit.pitch);
  assert.notDeepEqual(movedByKey(orbit, "ArrowUp", true).target, orbit.target);
  assert.ok(movedByKey(orbit, "+", true).distance < orbit.distance);
  assert.equal(movedByKey(orbit, "n", false), null);
});

test("the view says which cameras it cannot place, and that none was calibrated", () => {
  const geometry = { rotation_xyzw: [0, 0, 0, 1], translation_m: [0, 0, 0] };
  const source = (camera, more = {}) => ({ id: `${camera}/depth`, camera, isShown: true, geometry, ...more });
  const all = () => true;
  assert.match(cloudHint([], all), /no depth/);
  assert.match(cloudHint([source("a", { isShown: false })], all), /No camera/);
  assert.match(cloudHint([source("a"), source("b", { geometry: null })], all), /^b\/depth: .*intrinsics/);
  assert.equal(cloudHint([source("a"), source("b", { geometry: null })], (id) => id === "a/depth"), "", "not yet known");
  assert.match(cloudHint([source("a"), source("b")], all), /depthrig calibrate/);
  assert.equal(cloudHint([source("a"), source("a", { id: "a/depth_refined" })], all), "", "of one camera");
  const moved = { ...geometry, translation_m: [0.1, 0, 0] };
  assert.equal(cloudHint([source("a"), source("b", { geometry: moved })], all), "");
});
