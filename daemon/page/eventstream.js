/** Server-sent events out of pieces of text: a pure class. `EventSource` cannot send the token. */

export class EventParser {
  #rest = "";

  /**
   * @param {string} text the next piece
   * @returns {string[]} data of the events that are complete
   */
  push(text) {
    const blocks = (this.#rest + text).replaceAll("\r\n", "\n").split("\n\n");
    this.#rest = blocks.pop() ?? "";
    return blocks.map(dataOf).filter((data) => data !== "");
  }
}

/** @param {string} block */
function dataOf(block) {
  const lines = block.split("\n").filter((line) => line.startsWith("data:"));
  return lines.map((line) => line.slice("data:".length).trimStart()).join("\n");
}
