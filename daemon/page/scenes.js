/** Scenes that were used before: pure functions. */

const MOST = 20;

/**
 * @param {string | null} text what was stored
 * @returns {string[]} newest first
 */
export function parseScenes(text) {
  try {
    /** @type {unknown} */
    const scenes = JSON.parse(text ?? "[]");
    return Array.isArray(scenes) ? scenes.filter((scene) => typeof scene === "string").slice(0, MOST) : [];
  } catch {
    return [];
  }
}

/**
 * @param {string[]} scenes
 * @param {string} scene
 */
export function addScene(scenes, scene) {
  return scene === "" ? scenes : [scene, ...scenes.filter((other) => other !== scene)].slice(0, MOST);
}
