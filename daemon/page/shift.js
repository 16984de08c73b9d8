/**
 * How far an image has moved against another: phase correlation. Pure functions.
 *
 * C. D. Kuglin and D. C. Hines, "The phase correlation image alignment method", 1975. The spectrum is weighted with a
 * Gaussian, so that the peak is one as well, of which three points give the maximum between pixels.
 */

/** Side of the square that is transformed; a power of two. */
export const SIDE = 256;
/** Width of the peak, pixels of the square. */
const PEAK_SIGMA = 1;
/** Of noise, the highest value lies 4 to 5 standard deviations above the others; of an image that is found, 10 to 140. */
const FOUND_FROM = 7;
const SURE_FROM = 12;
/** Another peak this high means that parts of the scene have moved differently. */
const SECOND_TO = 0.7;
const PEAK_RADIUS = 4;
/** Levels of luma: an image with less has nothing to be found by. */
const LEAST_DEVIATION = 1;
const NEWTON_STEPS = 4;
/** A maximum farther from the peak is another one. */
const NEAR_PX = 1;
/** A share of the mean of the spectrum; what lies far below it is rounding. */
const FLOOR = 1e-3;

/** @typedef {"sure" | "unsure" | "none"} Certainty */
/** @typedef {{dx: number, dy: number, certainty: Certainty, score: number}} Shift pixels; to the right and down */
/** @typedef {{re: Float32Array, im: Float32Array, factor: number, deviation: number}} Spectrum */
/** @typedef {{left: number, top: number, width: number, height: number}} Part of an image, pixels */
/** @typedef {{luma: Uint8Array, columns: number, rows: number}} Luma */

const { cosines, sines } = tables();

function tables() {
  const angles = Array.from({ length: SIDE / 2 }, (_, i) => (-2 * Math.PI * i) / SIDE);
  return { cosines: Float64Array.from(angles, Math.cos), sines: Float64Array.from(angles, Math.sin) };
}

/**
 * Fourier transform of one row of the square in place (Cooley and Tukey, radix 2).
 *
 * @param {Float32Array} re
 * @param {Float32Array} im
 * @param {number} start of the row
 * @param {number} stride between its values
 */
function transformRow(re, im, start, stride) {
  for (let i = 1, j = 0; i < SIDE; i++) {
    let bit = SIDE >> 1;
    for (; j & bit; bit >>= 1) {
      j ^= bit;
    }
    j ^= bit;
    if (i < j) {
      swap(re, start + i * stride, start + j * stride);
      swap(im, start + i * stride, start + j * stride);
    }
  }
  for (let half = 1; half < SIDE; half *= 2) {
    const step = SIDE / (2 * half);
    for (let block = 0; block < SIDE; block += 2 * half) {
      for (let k = 0; k < half; k++) {
        const c = cosines[k * step];
        const s = sines[k * step];
        const a = start + (block + k) * stride;
        const b = a + half * stride;
        const bRe = re[b] * c - im[b] * s;
        const bIm = re[b] * s + im[b] * c;
        re[b] = re[a] - bRe;
        im[b] = im[a] - bIm;
        re[a] += bRe;
        im[a] += bIm;
      }
    }
  }
}

/**
 * @param {Float32Array} values
 * @param {number} a
 * @param {number} b
 */
function swap(values, a, b) {
  const value = values[a];
  values[a] = values[b];
  values[b] = value;
}

/**
 * @param {Float32Array} re
 * @param {Float32Array} im
 * @param {number} rows those below are 0
 */
function transform(re, im, rows) {
  for (let i = 0; i < rows; i++) {
    transformRow(re, im, i * SIDE, 1);
  }
  for (let i = 0; i < SIDE; i++) {
    transformRow(re, im, i, SIDE);
  }
}

/**
 * The spectrum of a part of an image, made so much smaller by means over squares that it fits.
 *
 * @param {Luma} image
 * @param {Part} part
 * @returns {Spectrum}
 */
export function spectrumOf({ luma, columns }, { left, top, width, height }) {
  const factor = Math.max(1, Math.ceil(Math.max(width, height) / SIDE));
  const across = Math.floor(width / factor);
  const down = Math.floor(height / factor);
  const re = new Float32Array(SIDE * SIDE);
  const im = new Float32Array(SIDE * SIDE);
  let sum = 0;
  let squares = 0;
  for (let y = 0; y < down; y++) {
    for (let x = 0; x < across; x++) {
      let mean = 0;
      for (let j = 0; j < factor; j++) {
        const row = (top + y * factor + j) * columns + left + x * factor;
        for (let i = 0; i < factor; i++) {
          mean += luma[row + i];
        }
      }
      mean /= factor * factor;
      re[y * SIDE + x] = mean;
      sum += mean;
      squares += mean * mean;
    }
  }
  const count = Math.max(1, across * down);
  const mean = sum / count;
  const deviation = Math.sqrt(Math.max(0, squares / count - mean * mean));
  const hann = (/** @type {number} */ i, /** @type {number} */ n) => 0.5 - 0.5 * Math.cos((2 * Math.PI * (i + 0.5)) / n);
  for (let y = 0; y < down; y++) {
    const weight = hann(y, down);
    for (let x = 0; x < across; x++) {
      re[y * SIDE + x] = (re[y * SIDE + x] - mean) * weight * hann(x, across);
    }
  }
  transform(re, im, down);
  return { re, im, factor, deviation };
}

/** Radians a pixel of the frequencies of a row. */
const OMEGAS = Float64Array.from({ length: SIDE }, (_, i) => (2 * Math.PI * (i < SIDE / 2 ? i : i - SIDE)) / SIDE);

/** Gaussian over the frequencies of a row. */
const WEIGHTS = Float64Array.from({ length: SIDE }, (_, i) => {
  const frequency = Math.min(i, SIDE - i) / SIDE;
  return Math.exp(-2 * (Math.PI * PEAK_SIGMA * frequency) ** 2);
});

/**
 * How far `live` has moved against `reference`, pixels of the images.
 *
 * @param {Spectrum} reference
 * @param {Spectrum} live of a part of the same size
 * @returns {Shift}
 */
export function shiftBetween(reference, live) {
  /** @type {Shift} */
  const none = { dx: 0, dy: 0, certainty: "none", score: 0 };
  if (Math.min(reference.deviation, live.deviation) < LEAST_DEVIATION) {
    return none;
  }
  const surface = correlation(reference, live);
  const { at, score, second } = highest(surface);
  if (!(score >= FOUND_FROM)) {
    return { ...none, score: Number.isFinite(score) ? score : 0 };
  }
  const x = at % SIDE;
  const y = Math.floor(at / SIDE);
  const signed = (/** @type {number} */ i) => (i < SIDE / 2 ? i : i - SIDE);
  const value = (/** @type {number} */ i, /** @type {number} */ j) => surface[((j + SIDE) % SIDE) * SIDE + ((i + SIDE) % SIDE)];
  return {
    dx: (signed(x) + between(value(x - 1, y), value(x, y), value(x + 1, y))) * live.factor,
    dy: (signed(y) + between(value(x, y - 1), value(x, y), value(x, y + 1))) * live.factor,
    certainty: score >= SURE_FROM && second <= SECOND_TO ? "sure" : "unsure",
    score,
  };
}

/**
 * @param {Spectrum} reference
 * @param {Spectrum} live
 * @returns {Float32Array} how well the images agree at each shift
 */
function correlation(reference, live) {
  const re = new Float32Array(SIDE * SIDE);
  const im = new Float32Array(SIDE * SIDE);
  let mean = 0;
  for (let i = 0; i < re.length; i++) {
    re[i] = live.re[i] * reference.re[i] + live.im[i] * reference.im[i];
    im[i] = live.im[i] * reference.re[i] - live.re[i] * reference.im[i];
    mean += Math.hypot(re[i], im[i]) / re.length;
  }
  for (let i = 0; i < re.length; i++) {
    const weight = (WEIGHTS[i % SIDE] * WEIGHTS[Math.floor(i / SIDE)]) / (Math.hypot(re[i], im[i]) + FLOOR * mean);
    re[i] *= weight;
    // The inverse transform is the conjugate of that of the conjugate.
    im[i] *= -weight;
  }
  transform(re, im, SIDE);
  return re;
}

/**
 * The peak, how many standard deviations it is high, and how high the next one beside it is, as a share of it.
 *
 * @param {Float32Array} surface
 */
function highest(surface) {
  let at = 0;
  let sum = 0;
  let squares = 0;
  for (let i = 0; i < surface.length; i++) {
    at = surface[i] > surface[at] ? i : at;
    sum += surface[i];
    squares += surface[i] ** 2;
  }
  const mean = sum / surface.length;
  const deviation = Math.sqrt(squares / surface.length - mean * mean);
  let second = -Infinity;
  for (let i = 0; i < surface.length; i++) {
    const away = (/** @type {number} */ a, /** @type {number} */ b) => Math.min(Math.abs(a - b), SIDE - Math.abs(a - b));
    const isBeside = away(i % SIDE, at % SIDE) > PEAK_RADIUS || away(Math.floor(i / SIDE), Math.floor(at / SIDE)) > PEAK_RADIUS;
    second = isBeside ? Math.max(second, surface[i]) : second;
  }
  return { at, score: (surface[at] - mean) / deviation, second: second / surface[at] };
}

/**
 * Where between pixels the maximum lies: of the parabola through the logarithms, which a Gaussian peak has.
 *
 * @param {number} before
 * @param {number} peak
 * @param {number} after
 */
function between(before, peak, after) {
  const isPositive = Math.min(before, after) > 0;
  const [a, b, c] = isPositive ? [before, peak, after].map(Math.log) : [before, peak, after];
  const bend = a - 2 * b + c;
  return bend < 0 ? Math.min(0.5, Math.max(-0.5, (0.5 * (a - c)) / bend)) : 0;
}

/**
 * The shift nearest to `rough` at which the gradients of both images agree best: Newton's method on their correlation,
 * between pixels. Phase correlation gives every frequency one voice; here those speak that the images have.
 *
 * @param {Spectrum} reference
 * @param {Spectrum} live
 * @param {Shift} rough
 * @returns {Shift}
 */
function refine(reference, live, rough) {
  const factor = live.factor;
  let dx = rough.dx / factor;
  let dy = rough.dy / factor;
  for (let step = 0; step < NEWTON_STEPS; step++) {
    let [gx, gy, xx, xy, yy] = [0, 0, 0, 0, 0];
    for (let j = 0; j <= SIDE / 2; j++) {
      const v = OMEGAS[j];
      for (let i = 0; i < SIDE; i++) {
        const n = j * SIDE + i;
        const u = OMEGAS[i];
        const weight = WEIGHTS[i] * WEIGHTS[j] * (u * u + v * v);
        const re = live.re[n] * reference.re[n] + live.im[n] * reference.im[n];
        const im = live.im[n] * reference.re[n] - live.re[n] * reference.im[n];
        const angle = u * dx + v * dy;
        const c = Math.cos(angle);
        const s = Math.sin(angle);
        const along = weight * (re * c - im * s);
        const across = weight * (re * s + im * c);
        gx += u * across;
        gy += v * across;
        xx += u * u * along;
        xy += u * v * along;
        yy += v * v * along;
      }
    }
    const determinant = xx * yy - xy * xy;
    if (!(xx > 0 && determinant > 0)) {
      return rough;
    }
    dx -= (yy * gx - xy * gy) / determinant;
    dy -= (xx * gy - xy * gx) / determinant;
  }
  const isNear = Math.hypot(dx - rough.dx / factor, dy - rough.dy / factor) <= NEAR_PX;
  return isNear ? { ...rough, dx: dx * factor, dy: dy * factor } : rough;
}

/** A reference image, ready to be compared with. */
export class ShiftMeter {
  #image;
  #whole;

  /** @param {Luma} image */
  constructor(image) {
    this.#image = image;
    this.#whole = spectrumOf(image, { left: 0, top: 0, width: image.columns, height: image.rows });
  }

  /**
   * How far an image of the same size has moved: found on the whole image, then measured at full resolution where
   * both show the same.
   *
   * @param {Luma} image
   * @returns {Shift} pixels of this image
   */
  measure(image) {
    const { columns, rows } = image;
    const rough = shiftBetween(this.#whole, spectrumOf(image, { left: 0, top: 0, width: columns, height: rows }));
    if (rough.certainty === "none") {
      return rough;
    }
    const x = Math.round(rough.dx);
    const y = Math.round(rough.dy);
    const width = Math.min(SIDE, columns - Math.abs(x));
    const height = Math.min(SIDE, rows - Math.abs(y));
    const left = Math.max(0, -x) + Math.floor((columns - Math.abs(x) - width) / 2);
    const top = Math.max(0, -y) + Math.floor((rows - Math.abs(y) - height) / 2);
    const before = spectrumOf(this.#image, { left, top, width, height });
    const after = spectrumOf(image, { left: left + x, top: top + y, width, height });
    const rest = shiftBetween(before, after);
    if (rest.certainty === "none" || Math.hypot(rest.dx, rest.dy) > 2 * this.#whole.factor) {
      // The middle has too little texture.
      return rough;
    }
    const { dx, dy } = refine(before, after, rest);
    return { ...rough, dx: x + dx, dy: y + dy, certainty: rest.certainty };
  }
}
