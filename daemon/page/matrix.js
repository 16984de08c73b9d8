/** Vectors, and 4x4 matrices column by column as WebGL takes them: pure functions. */

/** @typedef {[number, number, number]} Vector */
/** @typedef {number[]} Matrix 16 numbers, column by column */

/** @type {Matrix} */
export const IDENTITY = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];

/**
 * @param {Vector} a
 * @param {Vector} b
 * @returns {Vector}
 */
export function add(a, b) {
  return [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
}

/**
 * @param {Vector} a
 * @param {number} factor
 * @returns {Vector}
 */
export function scale(a, factor) {
  return [a[0] * factor, a[1] * factor, a[2] * factor];
}

/**
 * @param {Vector} a
 * @param {Vector} b
 * @returns {Vector}
 */
export function subtract(a, b) {
  return add(a, scale(b, -1));
}

/**
 * @param {Vector} a
 * @param {Vector} b
 */
export function dot(a, b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

/**
 * @param {Vector} a
 * @param {Vector} b
 * @returns {Vector}
 */
export function cross(a, b) {
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}

/** @param {Vector} a */
export function length(a) {
  return Math.hypot(...a);
}

/**
 * The vector with the length 1; the null vector as it is.
 *
 * @param {Vector} a
 * @returns {Vector}
 */
export function unit(a) {
  const size = length(a);
  return size > 0 ? scale(a, 1 / size) : a;
}

/**
 * @param {Matrix} a
 * @param {Matrix} b is applied first
 * @returns {Matrix}
 */
export function multiply(a, b) {
  /** @type {Matrix} */
  const product = [];
  for (let column = 0; column < 4; column++) {
    for (let row = 0; row < 4; row++) {
      let sum = 0;
      for (let k = 0; k < 4; k++) {
        sum += a[k * 4 + row] * b[column * 4 + k];
      }
      product.push(sum);
    }
  }
  return product;
}

/**
 * The point in homogeneous coordinates after the matrix.
 *
 * @param {Matrix} m
 * @param {Vector} p
 * @returns {[number, number, number, number]}
 */
export function transform(m, [x, y, z]) {
  const row = (/** @type {number} */ i) => m[i] * x + m[4 + i] * y + m[8 + i] * z + m[12 + i];
  return [row(0), row(1), row(2), row(3)];
}

/**
 * A direction after the rotation of a matrix.
 *
 * @param {Matrix} m
 * @param {Vector} v
 * @returns {Vector}
 */
export function rotate(m, [x, y, z]) {
  const row = (/** @type {number} */ i) => m[i] * x + m[4 + i] * y + m[8 + i] * z;
  return [row(0), row(1), row(2)];
}

/**
 * The pose `p' = R p + t` as a matrix.
 *
 * @param {[number, number, number, number]} rotation quaternion x y z w
 * @param {Vector} translation
 * @returns {Matrix}
 */
export function poseMatrix(rotation, translation) {
  const size = Math.hypot(...rotation) || 1;
  const [x, y, z, w] = rotation.map((part) => part / size);
  return [
    1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y), 0,
    2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x), 0,
    2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y), 0,
    translation[0], translation[1], translation[2], 1,
  ];
}

/**
 * The inverse of a rotation with a translation.
 *
 * @param {Matrix} m
 * @returns {Matrix}
 */
export function inversePose(m) {
  const rotation = [m[0], m[4], m[8], 0, m[1], m[5], m[9], 0, m[2], m[6], m[10], 0, 0, 0, 0, 1];
  const [x, y, z] = rotate(rotation, [m[12], m[13], m[14]]);
  return [...rotation.slice(0, 12), -x, -y, -z, 1];
}

/**
 * From the view's frame (x right, y up, z towards the eye) to the clip space.
 *
 * @param {number} fovY radians
 * @param {number} aspect width by height
 * @param {number} near
 * @param {number} far
 * @returns {Matrix}
 */
export function perspective(fovY, aspect, near, far) {
  const f = 1 / Math.tan(fovY / 2);
  const depth = 1 / (near - far);
  return [f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (near + far) * depth, -1, 0, 0, 2 * near * far * depth, 0];
}

/**
 * From the world to the frame of a view.
 *
 * @param {Vector} eye
 * @param {Vector} target
 * @param {Vector} up not along the line of sight
 * @returns {Matrix}
 */
export function lookAt(eye, target, up) {
  const back = unit(subtract(eye, target));
  const right = unit(cross(up, back));
  const top = cross(back, right);
  return [
    right[0], top[0], back[0], 0,
    right[1], top[1], back[1], 0,
    right[2], top[2], back[2], 0,
    -dot(right, eye), -dot(top, eye), -dot(back, eye), 1,
  ];
}
