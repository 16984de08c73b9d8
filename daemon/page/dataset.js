/** The dataset that the address names: pure functions. */

/**
 * @param {string} search such as `?dataset=2026-01-01_kitchen`
 * @returns {string | null} `null`: the live rig
 */
export function datasetOf(search) {
  return new URLSearchParams(search).get("dataset") || null;
}

/**
 * @param {string} path of the page
 * @param {string | null} dataset
 */
export function addressOf(path, dataset) {
  return dataset === null ? path : `${path}?dataset=${encodeURIComponent(dataset)}`;
}

/**
 * Where images and status come from.
 *
 * @param {{protocol: string, host: string}} place
 * @param {string | null} dataset
 */
export function socketAddress({ protocol, host }, dataset) {
  return addressOf(`${protocol === "https:" ? "wss" : "ws"}://${host}/v1/live`, dataset);
}
