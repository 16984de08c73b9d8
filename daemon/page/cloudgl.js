/** Draws points and lines with WebGL2. */

import { FRAGMENT, LINES_VERTEX, POINTS_VERTEX } from "./cloudshaders.js";
import { poseOf } from "./cloudscene.js";
import { FARTHEST_X, turbo } from "./colormap.js";
import { MODEL_CODES, coefficients, maxRadius, rayTable } from "./lens.js";
import { inversePose, multiply } from "./matrix.js";
import { depthOf } from "./protocol.js";

/** @typedef {import("./matrix.js").Matrix} Matrix */
/** @typedef {import("./types.js").Geometry} Geometry */
/** @typedef {import("./types.js").Image} Image */

const BACKGROUND = [0.047, 0.055, 0.067];
const TURBO_STEPS = 256;
const PAINTS = { color: 0, distance: 1, camera: 2 };
/** Points without colour are drawn as if they were farther away by this share. */
const BEHIND_SHARE = 0.03;
const UNITS = { depth: 0, rays: 1, color: 2, turbo: 3 };

/** @typedef {keyof typeof PAINTS} Paint */

/**
 * @typedef {Object} CloudTextures of a camera
 * @property {WebGLTexture} depth
 * @property {WebGLTexture} rays
 * @property {WebGLTexture} color
 * @property {string} raysOf what the rays were computed for
 *
 * @typedef {Object} CloudPoints a camera's part of the cloud
 * @property {CloudTextures} textures
 * @property {Geometry} depth
 * @property {Geometry | null} color `null` without a colour image
 * @property {number} unitM
 * @property {number} step a pixel of the depth image stands for so many of the full one
 * @property {number} columns of the depth image
 * @property {{columns: number, rows: number}} grid
 * @property {[number, number, number]} tint
 * @property {boolean} isStale
 *
 * @typedef {Object} Frame
 * @property {Matrix} viewProjection
 * @property {Matrix} projection
 * @property {{near: number, far: number}} range
 * @property {boolean} isClipped
 * @property {Paint} paint
 * @property {CloudPoints[]} clouds
 * @property {{lines: number[], color: [number, number, number]}[]} lines
 */

export class CloudRenderer {
  #gl;
  #points;
  #lines;
  #lineBuffer;
  #lineArray;
  #pointArray;
  #turbo;
  /** @type {WebGLSync | null} signalled when the frame before is drawn */
  #fence = null;

  /** @param {WebGL2RenderingContext} gl */
  constructor(gl) {
    this.#gl = gl;
    this.#points = new Program(gl, POINTS_VERTEX, FRAGMENT);
    this.#lines = new Program(gl, LINES_VERTEX, FRAGMENT);
    this.#pointArray = gl.createVertexArray();
    this.#lineArray = gl.createVertexArray();
    this.#lineBuffer = gl.createBuffer();
    gl.bindVertexArray(this.#lineArray);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.#lineBuffer);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 0, 0);
    gl.enable(gl.DEPTH_TEST);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    this.#turbo = this.#texture(gl.NEAREST);
    const colors = new Uint8Array(TURBO_STEPS * 4);
    for (let i = 0; i < TURBO_STEPS; i++) {
      const x = FARTHEST_X + (1 - FARTHEST_X) * (i / (TURBO_STEPS - 1));
      colors.set([...turbo(x), 255], i * 4);
    }
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, TURBO_STEPS, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, colors);
  }

  /** @returns {CloudTextures} */
  createTextures() {
    const gl = this.#gl;
    return {
      depth: this.#texture(gl.NEAREST),
      rays: this.#texture(gl.NEAREST),
      color: this.#texture(gl.LINEAR),
      raysOf: "",
    };
  }

  /** @param {CloudTextures} textures */
  deleteTextures(textures) {
    for (const texture of [textures.depth, textures.rays, textures.color]) {
      this.#gl.deleteTexture(texture);
    }
  }

  /**
   * @param {CloudTextures} textures
   * @param {Image} image
   */
  putDepth(textures, image) {
    const gl = this.#gl;
    gl.bindTexture(gl.TEXTURE_2D, textures.depth);
    const { columns, rows } = image;
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.R16UI, columns, rows, 0, gl.RED_INTEGER, gl.UNSIGNED_SHORT, depthOf(image));
  }

  /**
   * @param {CloudTextures} textures
   * @param {ImageBitmap} bitmap
   */
  putColor(textures, bitmap) {
    const gl = this.#gl;
    gl.bindTexture(gl.TEXTURE_2D, textures.color);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, bitmap);
  }

  /**
   * Computes the rays of a depth image, if they are not there.
   *
   * @param {CloudTextures} textures
   * @param {Geometry} geometry
   * @param {{columns: number, rows: number, step: number}} image
   * @returns {Float32Array | null} `null`: they are there
   */
  putRays(textures, geometry, { columns, rows, step }) {
    const gl = this.#gl;
    const key = JSON.stringify([geometry.intrinsics, columns, rows, step]);
    if (textures.raysOf === key) {
      return null;
    }
    textures.raysOf = key;
    const rays = rayTable(geometry.intrinsics, columns, rows, step);
    gl.bindTexture(gl.TEXTURE_2D, textures.rays);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RG32F, columns, rows, 0, gl.RG, gl.FLOAT, rays);
    return rays;
  }

  /** Whether the frame before is still drawn. */
  get isBusy() {
    const gl = this.#gl;
    if (this.#fence === null || gl.getSyncParameter(this.#fence, gl.SYNC_STATUS) === gl.SIGNALED) {
      gl.deleteSync(this.#fence);
      this.#fence = null;
    }
    return this.#fence !== null;
  }

  /** @param {Frame} frame */
  draw(frame) {
    const gl = this.#gl;
    gl.viewport(0, 0, gl.drawingBufferWidth, gl.drawingBufferHeight);
    gl.clearColor(BACKGROUND[0], BACKGROUND[1], BACKGROUND[2], 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    this.#drawPoints(frame);
    this.#drawLines(frame);
    this.#fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
  }

  /** @param {Frame} frame */
  #drawPoints(frame) {
    const gl = this.#gl;
    const at = this.#points.use();
    gl.bindVertexArray(this.#pointArray);
    gl.uniform1i(at("depth_image"), UNITS.depth);
    gl.uniform1i(at("rays"), UNITS.rays);
    gl.uniform1i(at("color_image"), UNITS.color);
    gl.uniform1i(at("turbo"), UNITS.turbo);
    gl.uniformMatrix4fv(at("view_projection"), false, frame.viewProjection);
    const { projection } = frame;
    gl.uniform1f(at("behind"), -BEHIND_SHARE * projection[14]);
    gl.uniform2f(at("range"), frame.range.near, frame.range.far);
    gl.uniform1i(at("is_clipped"), Number(frame.isClipped));
    gl.uniform1i(at("paint"), PAINTS[frame.paint]);
    this.#bind(UNITS.turbo, this.#turbo);
    for (const cloud of frame.clouds) {
      const { fx } = cloud.depth.intrinsics;
      const apart = (cloud.step * cloud.columns) / cloud.grid.columns / fx;
      const pose = poseOf(cloud.depth);
      gl.uniform2i(at("grid"), cloud.grid.columns, cloud.grid.rows);
      gl.uniform1f(at("unit_m"), cloud.unitM);
      gl.uniformMatrix4fv(at("pose"), false, pose);
      gl.uniform1f(at("pixel_size"), (apart * projection[5] * gl.drawingBufferHeight) / 2);
      gl.uniform3fv(at("tint"), cloud.tint);
      gl.uniform1i(at("is_stale"), Number(cloud.isStale));
      this.#setColor(at, cloud.color, pose);
      this.#bind(UNITS.depth, cloud.textures.depth);
      this.#bind(UNITS.rays, cloud.textures.rays);
      this.#bind(UNITS.color, cloud.textures.color);
      gl.drawArrays(gl.POINTS, 0, cloud.grid.columns * cloud.grid.rows);
    }
    gl.activeTexture(gl.TEXTURE0);
  }

  /**
   * @param {(name: string) => WebGLUniformLocation | null} at
   * @param {Geometry | null} color
   * @param {Matrix} depthPose
   */
  #setColor(at, color, depthPose) {
    const gl = this.#gl;
    gl.uniform1i(at("has_color"), Number(color !== null));
    if (color === null) {
      return;
    }
    const { intrinsics, width, height } = color;
    gl.uniformMatrix4fv(at("to_color"), false, multiply(inversePose(poseOf(color)), depthPose));
    gl.uniform4f(at("pinhole"), intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy);
    gl.uniform2f(at("color_size"), width, height);
    gl.uniform1i(at("model"), MODEL_CODES[intrinsics.model] ?? 0);
    gl.uniform1fv(at("k"), coefficients(intrinsics));
    gl.uniform1f(at("max_radius"), maxRadius(intrinsics));
  }

  /** @param {Frame} frame */
  #drawLines(frame) {
    const gl = this.#gl;
    const at = this.#lines.use();
    gl.uniformMatrix4fv(at("view_projection"), false, frame.viewProjection);
    gl.bindVertexArray(this.#lineArray);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.#lineBuffer);
    for (const { lines, color } of frame.lines) {
      gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(lines), gl.STREAM_DRAW);
      gl.uniform3fv(at("line_color"), color);
      gl.drawArrays(gl.LINES, 0, lines.length / 3);
    }
  }

  /** @param {number} filter */
  #texture(filter) {
    const gl = this.#gl;
    const texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, filter);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, filter);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
    return texture;
  }

  /**
   * @param {number} unit
   * @param {WebGLTexture} texture
   */
  #bind(unit, texture) {
    this.#gl.activeTexture(this.#gl.TEXTURE0 + unit);
    this.#gl.bindTexture(this.#gl.TEXTURE_2D, texture);
  }
}

class Program {
  #gl;
  #program;
  /** @type {Map<string, WebGLUniformLocation | null>} */
  #places = new Map();

  /**
   * @param {WebGL2RenderingContext} gl
   * @param {string} vertex
   * @param {string} fragment
   */
  constructor(gl, vertex, fragment) {
    this.#gl = gl;
    this.#program = gl.createProgram();
    for (const [kind, source] of /** @type {const} */ ([[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]])) {
      const shader = gl.createShader(kind);
      if (shader === null) {
        throw new Error("the graphics context was lost");
      }
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(this.#program, shader);
    }
    gl.linkProgram(this.#program);
    if (!gl.getProgramParameter(this.#program, gl.LINK_STATUS) && !gl.isContextLost()) {
      throw new Error(`the shaders of the 3-D view are refused: ${gl.getProgramInfoLog(this.#program) ?? ""}`);
    }
  }

  /** @returns {(name: string) => WebGLUniformLocation | null} where a uniform is */
  use() {
    this.#gl.useProgram(this.#program);
    return (name) => {
      let place = this.#places.get(name);
      if (place === undefined) {
        place = this.#gl.getUniformLocation(this.#program, name);
        this.#places.set(name, place);
      }
      return place;
    };
  }
}
