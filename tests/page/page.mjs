/**
 * Loads modules of the page in Node 18, which takes a `.js` file for CommonJS unless a package.json beside it says
 * otherwise. The page's folder holds only what is served, so its modules are copied beside one.
 */

import { copyFileSync, mkdtempSync, readdirSync, rmSync, writeFileSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { fileURLToPath, pathToFileURL } from "node:url";

const page = fileURLToPath(new URL("../../daemon/page/", import.meta.url));
const copy = mkdtempSync(join(tmpdir(), "depthrig-page-"));
process.on("exit", () => rmSync(copy, { recursive: true, force: true }));
writeFileSync(join(copy, "package.json"), '{"type": "module"}');
for (const file of readdirSync(page).filter((name) => name.endsWith(".js"))) {
  copyFileSync(join(page, file), join(copy, file));
}

/** @param {string} file such as `protocol.js` */
export function load(file) {
  return import(pathToFileURL(join(copy, file)).href);
}
