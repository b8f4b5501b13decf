/** Pages that play motion without a server, opened from disk in a real Chromium; pytest has written them. */
import { type Browser, type BrowserContext, type Page } from "playwright-core";
import { afterAll, beforeAll, expect, it } from "vitest";
import { LONGEST_STEP_S } from "../src/player/clock.svelte";
import { colours, faults, launch, PATIENCE_MS, picture, scene } from "./looking";

interface Given {
  chromium: string;
  /** Address of the folder with the pages. */
  folder: string;
  /** Positions of joints in metres that the server computes, by frame of the first clip. */
  positions: Record<string, number[]>;
  /** Frames per second of the first clip. */
  rate: number;
  /** Names of the first clip, of the same clip with markup for a name, and of the second clip. */
  names: [string, string, string];
}

const GIVEN = JSON.parse(process.env["MAREY_WEB_GIVEN"]!) as Given;
/** Greatest distance of a joint from where the server computes it: the rotations of all its parents are rounded. */
const TOLERANCE_M = 1e-3;

let browser: Browser;
let context: BrowserContext;
const complaints: string[] = [];
const requests: string[] = [];

beforeAll(async () => {
  browser = await launch(GIVEN.chromium);
  context = await browser.newContext({ viewport: { width: 1280, height: 800 }, colorScheme: "dark" });
  context.setDefaultTimeout(PATIENCE_MS);
});

afterAll(() => browser.close());

async function opened(name: string, options: { width?: number; test?: boolean } = {}): Promise<Page> {
  const page = await context.newPage();
  await page.setViewportSize({ width: options.width ?? 1280, height: 800 });
  page.on("console", (message) => message.type() === "error" && complaints.push(message.text()));
  page.on("pageerror", (error) => complaints.push(error.message));
  page.on("request", (request) => !/^data:/.test(request.url()) && requests.push(request.url()));
  await page.goto(`${GIVEN.folder}/${name}.html${options.test === false ? "" : "#test"}`);
  return page;
}

/** Return 12 steps from picture to picture: progress of the clip and passed time, in seconds; not where it begins again. */
const steps = (page: Page) =>
  page.evaluate(async () => {
    const picture = () => new Promise<number>((resolve) => requestAnimationFrame(resolve));
    const found: { progress: number; elapsed: number }[] = [];
    let [before, seconds] = [await picture(), window.marey!.seconds];
    for (let pictures = 0; pictures < 200 && found.length < 12; pictures++) {
      const now = await picture();
      const progress = window.marey!.seconds - seconds;
      if (progress >= 0) found.push({ progress, elapsed: (now - before) / 1000 });
      [before, seconds] = [now, seconds + progress];
    }
    return found;
  });

it("plays a clip at its rate, with every joint near where the server computes it", async () => {
  const page = await opened("alone");
  let state = await scene(page, (one) => one.actors.length === 1 && one.seconds > 0);
  expect([state.stage, state.actors[0]!.name]).toEqual(["webgl", GIVEN.names[0]]);
  const played = await steps(page);
  expect(played.length).toBe(12);
  for (const { progress, elapsed } of played) expect(progress).toBeCloseTo(Math.min(elapsed, LONGEST_STEP_S), 6);
  await page.getByRole("button", { name: "Pause" }).click();
  for (const [frame, expected] of Object.entries(GIVEN.positions)) {
    await page.getByRole("slider", { name: "Frame" }).fill(frame);
    state = await scene(page, (one) => one.actors[0]!.frame === Number(frame));
    expect(Math.abs(state.seconds - Number(frame) / GIVEN.rate)).toBeLessThan(1e-6);
    const errors = state.actors[0]!.positions.map((value, at) => Math.abs(value - expected[at]!));
    expect(errors.length).toBe(expected.length);
    expect(Math.max(...errors), `frame ${frame}`).toBeLessThan(TOLERANCE_M);
  }
  await expect.poll(() => colours(page), { timeout: PATIENCE_MS }).toBeGreaterThan(30);
  await picture(page, "player-alone");
  await page.close();
});

it("plays two clips beside each other, and shows markup in a name as text", async () => {
  const page = await opened("pair");
  const state = await scene(page, (one) => one.actors.length === 2);
  expect(state.actors.map((actor) => actor.name)).toEqual(GIVEN.names.slice(1));
  expect(await page.title()).toContain(GIVEN.names[1]);
  expect(await page.evaluate(() => "harmed" in window)).toBe(false);
  expect(await page.locator("img").count()).toBe(0);
  await page.getByRole("button", { name: "Pause" }).click();
  expect(await faults(page)).toEqual([]);
  await picture(page, "player-pair");
  await page.keyboard.press("v");
  await page.getByRole("button", { name: "Switch between dark and light" }).click();
  await scene(page, (one) => one.calls > 4);
  expect(await faults(page)).toEqual([]);
  await picture(page, "player-pair-light");
  await page.close();
});

it("fits a narrow window, also with five motions", async () => {
  for (const [name, count] of [["pair", 2], ["five", 5]] as const) {
    const page = await opened(name, { width: 390 });
    await scene(page, (one) => one.actors.length === count);
    expect(await page.evaluate(() => document.documentElement.scrollWidth)).toBeLessThanOrEqual(390);
    const heights = await page.locator(".label span").evaluateAll((labels) => labels.map((label) => label.clientHeight));
    expect(heights.length).toBe(count);
    expect(Math.max(...heights), "names of more than two lines would lie over heads").toBeLessThanOrEqual(36);
    await picture(page, `player-${name}-390`);
    await page.setViewportSize({ width: 1280, height: 800 });
    await picture(page, `player-${name}-1280`);
    await page.close();
  }
});

it("says that a page without motion has none", async () => {
  const page = await opened("empty", { test: false });
  await page.getByText("this page contains no motion").waitFor();
  expect(await faults(page)).toEqual([]);
  await page.close();
});

it("cannot request anything, and has complained about nothing until then", async () => {
  expect(complaints).toEqual([]);
  expect(requests.filter((url) => !url.startsWith(GIVEN.folder))).toEqual([]);
  expect(requests.length).toBe(5); // the pages themselves
  const page = await opened("alone");
  expect(await page.evaluate(() => fetch("data:text/plain,x").then(() => "sent", () => "refused"))).toBe("refused");
  expect(complaints.join()).toContain("Content Security Policy");
  await page.close();
});
