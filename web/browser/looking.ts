/** A real Chromium without a graphics processor, and what tests look at in its pages. */
import axe from "axe-core";
import { mkdirSync } from "node:fs";
import { join } from "node:path";
import { type Browser, chromium, type Page } from "playwright-core";

const FLAGS = [
  "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-dev-shm-usage",
  "--disable-background-networking", "--disable-component-update", "--disable-sync", "--no-first-run",
];
/** Folder for pictures of the pages; without it, none are taken. */
const PICTURES = process.env["MAREY_WEB_PICTURES"] ?? null;

export function launch(executablePath: string): Promise<Browser> {
  return chromium.launch({ executablePath, args: FLAGS });
}

/** Return the number of different colours in the picture of the canvas; a blank one has one. */
export function colours(where: Page): Promise<number> {
  return where.evaluate(() => {
    const canvas = document.querySelector("canvas")!;
    const copy = document.createElement("canvas");
    [copy.width, copy.height] = [canvas.width, canvas.height];
    const context = copy.getContext("2d")!;
    context.drawImage(canvas, 0, 0);
    return new Set(new Uint32Array(context.getImageData(0, 0, copy.width, copy.height).data.buffer)).size;
  });
}

export async function picture(where: Page, name: string): Promise<void> {
  if (PICTURES === null) return;
  mkdirSync(PICTURES, { recursive: true });
  await where.screenshot({ path: join(PICTURES, `${name}.png`) });
}

export async function faults(where: Page): Promise<string[]> {
  await where.evaluate(axe.source); // not as a script of the page, which the content security policy refuses
  const found = await where.evaluate(() => window.axe.run());
  return found.violations.map((one) => `${one.id}: ${one.nodes.map((node) => node.target.join(" ")).join(", ")}`);
}
