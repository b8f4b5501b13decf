// Prints the compressed size of the scripts that the pages load first, and the plain size of the page that plays motion
// without a server; fails if they are larger than agreed.
import { readdirSync, readFileSync } from "node:fs";
import { gzipSync } from "node:zlib";

const FOLDER = new URL("../server/marey_server/webui/assets/", import.meta.url);
const PLAYER = new URL("../server/marey_server/webui/player.html", import.meta.url);
const LIMITS = { "without 3D": 60_000, "with 3D": 230_000, "page without a server, not compressed": 700_000 };

const sizes = Object.fromEntries(
  readdirSync(FOLDER).filter((name) => name.endsWith(".js")).map((name) => [name, gzipSync(readFileSync(new URL(name, FOLDER))).length]),
);
const all = Object.values(sizes).reduce((sum, size) => sum + size, 0);
const scene = Object.entries(sizes).filter(([name]) => name.startsWith("webgl")).reduce((sum, [, size]) => sum + size, 0);
const found = { "without 3D": all - scene, "with 3D": all, "page without a server, not compressed": readFileSync(PLAYER).length };
for (const [what, size] of Object.entries(found)) {
  console.log(`${what}: ${(size / 1000).toFixed(1)} kB of at most ${LIMITS[what] / 1000} kB`);
  if (scene === 0 || size > LIMITS[what]) process.exitCode = 1;
}
