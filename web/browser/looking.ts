/** A real Chromium without a graphics processor, and what tests look at in its pages. */
import axe from "axe-core";
import { mkdirSync } from "node:fs";
import { join } from "node:path";
import { type Browser, type BrowserContext, chromium, type Locator, type Page } from "playwright-core";
import { expect, vi } from "vitest";
import type { SceneState } from "../src/player/testHandle";

const FLAGS = [
  "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-dev-shm-usage",
  "--disable-background-networking", "--disable-component-update", "--disable-sync", "--no-first-run",
];
/** Longest wait for anything in a page, in milliseconds: long, because machines may be busy. */
export const PATIENCE_MS = 240_000;
vi.setConfig({ testTimeout: 2 * PATIENCE_MS, hookTimeout: 2 * PATIENCE_MS });
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

/** Return the number of different colours in what a browser shows of an element, such as a frame with a canvas. */
export async function shownColours(element: Locator): Promise<number> {
  const shot = (await element.screenshot()).toString("base64");
  const blank = await element.page().context().newPage(); // without the content security policy of the page
  const count = await blank.evaluate(async (data) => {
    const image = new Image();
    image.src = `data:image/png;base64,${data}`;
    await image.decode();
    const copy = document.createElement("canvas");
    [copy.width, copy.height] = [image.width, image.height];
    const context = copy.getContext("2d")!;
    context.drawImage(image, 0, 0);
    return new Set(new Uint32Array(context.getImageData(0, 0, copy.width, copy.height).data.buffer)).size;
  }, shot);
  await blank.close();
  return count;
}

export async function picture(where: Page, name: string, fullPage = false): Promise<void> {
  if (PICTURES === null) return;
  mkdirSync(PICTURES, { recursive: true });
  await where.screenshot({ path: join(PICTURES, `${name}.png`), fullPage });
}

/** Rules of axe whose result depends on the colours of the page. */
export const COLOUR_RULES = ["color-contrast", "link-in-text-block"];

/** Return the faults that axe finds in a page, by all its rules or by the given ones. */
export async function faults(where: Page, rules: string[] | null = null): Promise<string[]> {
  await where.evaluate(axe.source); // not as a script of the page, which the content security policy refuses
  const found = await where.evaluate((some) => window.axe.run(some === null ? {} : { runOnly: some }), rules);
  return found.violations.map((one) => `${one.id}: ${one.nodes.map((node) => node.target.join(" ")).join(", ")}`);
}

/** Least height and width in pixels of what fingers can press. */
export const FINGER_PX = 44;

/** Return the names of buttons, lists and sliders that are too small for fingers. */
export function smallTargets(where: Page): Promise<string[]> {
  return where.evaluate((least) => {
    const targets = [...document.querySelectorAll<HTMLElement>("button, select, summary, input")].filter((one) => one.checkVisibility());
    const isSmall = ({ width, height }: DOMRect) => width < least || height < least;
    return targets.filter((one) => isSmall(one.getBoundingClientRect())).map((one) => one.innerText || one.ariaLabel || one.outerHTML);
  }, FINGER_PX);
}

/** Return the state of the scene as soon as it meets a condition. */
export async function scene(where: Page, meets: (state: SceneState) => boolean): Promise<SceneState> {
  let state: SceneState | undefined;
  for (const end = Date.now() + PATIENCE_MS; Date.now() < end; ) {
    state = await where.evaluate(() => window.marey);
    if (state !== undefined && meets(state)) return state;
    await where.waitForTimeout(50);
  }
  throw new Error(`the scene does not get there: ${JSON.stringify(state)?.slice(0, 300)}; page: ${await where.innerText("body")}`);
}

/** Print the time at which a page had painted its first pose, after its beginning or after a mark; pytest shows it with -s. */
export async function tellFirstPose(where: Page, what: string, since: string | null = null): Promise<void> {
  const passed = await where.evaluate((mark) => {
    const last = (name: string) => performance.getEntriesByName(name).at(-1)?.startTime;
    return last("marey-posed")! - (mark === null ? 0 : last(mark)!);
  }, since);
  expect(passed).toBeGreaterThan(0);
  console.log(`time: ${what}: first pose painted after ${passed.toFixed(0)} ms`);
}

/** End the session of a page by its button, and make sure that nothing of it is left. */
export async function signOut(where: Page, context: BrowserContext): Promise<void> {
  expect(await context.cookies()).toHaveLength(1);
  await where.getByRole("button", { name: "Sign out" }).click();
  await where.getByRole("heading", { name: "You are signed out" }).waitFor();
  expect(await context.cookies()).toEqual([]);
  expect(await faults(where)).toEqual([]);
  await where.reload();
  await where.getByText("You need a link to open this page").waitFor();
  expect(await where.getByRole("button", { name: "Sign out" }).count()).toBe(0);
}
