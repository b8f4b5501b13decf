/** The pages in a real Chromium, against a real server that pytest has started and filled (tests/integration/test_pages.py). */
import axe from "axe-core";
import { mkdirSync } from "node:fs";
import { join } from "node:path";
import { type Browser, type BrowserContext, chromium, type Page } from "playwright-core";
import { afterAll, beforeAll, expect, it } from "vitest";
import type { SceneState } from "../src/player/testHandle";

interface Given {
  chromium: string;
  /** Address of the page that shows two clips, with a code that works once. */
  link: string;
  /** Positions of joints in metres that the server computes, by frame of the first clip. */
  positions: Record<string, number[]>;
  clips: string[];
  pictures: string | null;
}

const GIVEN = JSON.parse(process.env["MAREY_WEB_GIVEN"]!) as Given;
const FLAGS = [
  "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-dev-shm-usage",
  "--disable-background-networking", "--disable-component-update", "--disable-sync", "--no-first-run",
];
const TOLERANCE_M = 1e-4;

let browser: Browser;
let context: BrowserContext;
let page: Page;
const complaints: string[] = [];

beforeAll(async () => {
  browser = await chromium.launch({ executablePath: GIVEN.chromium, args: FLAGS });
  context = await browser.newContext({ viewport: { width: 1280, height: 800 }, colorScheme: "dark" });
  page = await context.newPage();
  page.on("console", (message) => message.type() === "error" && complaints.push(message.text()));
  page.on("pageerror", (error) => complaints.push(error.message));
  await page.goto(`${GIVEN.link.replace("#", "&test=1#")}`);
});

afterAll(() => browser.close());

/** Return the state of the scene as soon as it meets a condition. */
async function scene(where: Page, meets: (state: SceneState) => boolean): Promise<SceneState> {
  let state: SceneState | undefined;
  for (let tries = 0; tries < 400; tries++) {
    state = await where.evaluate(() => window.marey);
    if (state !== undefined && meets(state)) return state;
    await where.waitForTimeout(50);
  }
  throw new Error(`the scene does not get there: ${JSON.stringify(state)?.slice(0, 300)}; page: ${await where.innerText("body")}`);
}

/** Return the number of different colours in the picture of the canvas; a blank one has one. */
function colours(where: Page): Promise<number> {
  return where.evaluate(() => {
    const canvas = document.querySelector("canvas")!;
    const copy = document.createElement("canvas");
    [copy.width, copy.height] = [canvas.width, canvas.height];
    const context = copy.getContext("2d")!;
    context.drawImage(canvas, 0, 0);
    return new Set(new Uint32Array(context.getImageData(0, 0, copy.width, copy.height).data.buffer)).size;
  });
}

async function picture(where: Page, name: string): Promise<void> {
  if (GIVEN.pictures === null) return;
  mkdirSync(GIVEN.pictures, { recursive: true });
  await where.screenshot({ path: join(GIVEN.pictures, `${name}.png`) });
}

async function faults(where: Page): Promise<string[]> {
  await where.evaluate(axe.source); // not as a script of the page, which the content security policy refuses
  const found = await where.evaluate(() => window.axe.run());
  return found.violations.map((one) => `${one.id}: ${one.nodes.map((node) => node.target.join(" ")).join(", ")}`);
}

it("draws both clips with WebGL, with every joint where the server computes it", async () => {
  let state = await scene(page, (one) => one.actors.length === 2);
  expect(state.stage).toBe("webgl");
  expect(state.actors.map((actor) => actor.name)).toEqual(GIVEN.clips);
  expect(state.calls).toBeGreaterThan(4);
  for (const [frame, expected] of Object.entries(GIVEN.positions)) {
    await page.getByRole("slider", { name: "Frame" }).fill(frame);
    state = await scene(page, (one) => one.actors[0]!.frame === Number(frame));
    const errors = state.actors[0]!.positions.map((value, at) => Math.abs(value - expected[at]!));
    expect(errors.length).toBe(expected.length);
    expect(Math.max(...errors), `frame ${frame}`).toBeLessThan(TOLERANCE_M);
  }
  expect(await colours(page)).toBeGreaterThan(30);
  await picture(page, "view-mannequins");
});

it("works with keys alone, and keeps all that is seen in its address, but not the code", async () => {
  expect(page.url()).not.toContain("mareyview_");
  await page.keyboard.press("Home");
  await page.keyboard.press("Shift+ArrowRight");
  await page.keyboard.press("ArrowLeft");
  await page.keyboard.press("v");
  await page.keyboard.press("c");
  await scene(page, (one) => one.actors[0]!.frame === 9 && one.camera.startsWith("0,8,"));
  await page.keyboard.press("Space");
  await scene(page, (one) => one.seconds > 0.3);
  await page.keyboard.press("Space");
  await page.keyboard.press("Home");
  await page.keyboard.press("ArrowRight");
  await expect.poll(() => page.url()).toMatch(/frame=1&camera=0,8,3&look=skeleton/);
  await picture(page, "view-skeletons");
});

it("shows the same again from the copied address, in a narrow window, with the cookie alone", async () => {
  const narrow = await context.newPage();
  await narrow.setViewportSize({ width: 390, height: 844 });
  await narrow.goto(page.url());
  const state = await scene(narrow, (one) => one.actors.length === 2);
  expect([state.actors[0]!.frame, state.camera]).toEqual([1, "0,8,3"]);
  expect(await narrow.evaluate(() => document.cookie)).toBe(""); // pages cannot read the cookie
  expect(await narrow.evaluate(() => document.documentElement.scrollWidth)).toBeLessThanOrEqual(390);
  await picture(narrow, "view-390");
  await narrow.close();
});

it("has no fault that axe finds, also with the help open", async () => {
  expect(await faults(page)).toEqual([]);
  await page.keyboard.press("Shift+?");
  await page.getByRole("heading", { name: "Keys" }).waitFor();
  expect(await faults(page)).toEqual([]);
  await picture(page, "view-keys");
  await page.getByRole("button", { name: "Close" }).click();
  expect(complaints).toEqual([]);
});

it("draws side views where there is no WebGL", async () => {
  const plain = await context.newPage();
  await plain.addInitScript(() => {
    const original = HTMLCanvasElement.prototype.getContext;
    HTMLCanvasElement.prototype.getContext = function (this: HTMLCanvasElement, kind: string, ...rest: unknown[]) {
      return kind.startsWith("webgl") ? null : Reflect.apply(original, this, [kind, ...rest]);
    } as typeof original;
  });
  await plain.goto(page.url());
  const state = await scene(plain, (one) => one.actors.length === 2);
  expect(state.stage).toBe("canvas");
  expect(await colours(plain)).toBeGreaterThan(5);
  await plain.getByText("This browser offers no WebGL").waitFor();
  await picture(plain, "view-without-webgl");
  await plain.close();
});

it("says what to do without a session, and for a link that was used", async () => {
  const stranger = await browser.newContext({ viewport: { width: 1280, height: 800 } });
  const other = await stranger.newPage();
  await other.goto(GIVEN.link); // its code was used above
  await other.getByText("This link is not valid").waitFor();
  await other.goto(page.url());
  await other.getByText("marey view PROJECT/CLIP --browser").waitFor();
  expect(await faults(other)).toEqual([]);
  await picture(other, "view-without-link");
  await other.goto(new URL("/s/", page.url()).href);
  await other.getByText("this address alone begins no study").waitFor();
  expect(await faults(other)).toEqual([]);
  await stranger.close();
});

it("lets a participant give consent, compare four motions, reload and withdraw", async () => {
  const study = await context.newPage();
  await study.setViewportSize({ width: 640, height: 480 }); // four figures without a graphics processor
  const errors: string[] = [];
  study.on("pageerror", (error) => errors.push(error.message));
  const sent = await standIn(study);
  await study.goto(`${new URL("/s/", page.url()).href}?test=1#mareystudy_abc_0123`);
  await study.getByRole("heading", { name: "Walks" }).waitFor();
  expect(study.url()).not.toContain("mareystudy_");
  expect(await faults(study)).toEqual([]);
  await picture(study, "study-consent");
  await study.getByRole("button", { name: "I agree, begin" }).click();
  await study.getByRole("button", { name: "Next (Space)" }).waitFor();
  await picture(study, "study-between");
  await study.keyboard.press("Space");
  await study.getByRole("button", { name: "Figure 4" }).waitFor();
  expect(await colours(study)).toBeGreaterThan(15);
  expect(await faults(study)).toEqual([]);
  await picture(study, "study-trial");
  await study.setViewportSize({ width: 390, height: 844 });
  await picture(study, "study-trial-390");
  await study.keyboard.press("2");
  await study.getByRole("button", { name: "Figure 3" }).click();
  await study.getByText("comparison is left").waitFor();
  expect(sent).toContainEqual(expect.objectContaining({ chosen: [1, 2] }));
  await study.reload();
  await study.getByText("comparison is left").waitFor();
  await study.getByRole("button", { name: "Withdraw" }).click();
  await study.getByRole("button", { name: "Delete them" }).click();
  await study.getByText("Your answers are deleted").waitFor();
  expect(await study.evaluate(() => localStorage.length)).toBe(0);
  expect(errors).toEqual([]);
  await study.close();
});

/** Answer the requests of a participant in place of the server, with the clips of the project; return the bodies sent. */
async function standIn(where: Page): Promise<unknown[]> {
  const sent: unknown[] = [];
  const clips = ["clip", "beside"].map((name) => new URL(page.url()).searchParams.get(name)!.split("/") as [string, string]);
  const server = new URL("/api/v1/", page.url()).href;
  let answered = 0;
  const state = () => ({
    title: "Walks", clips: 2, trials: 2, answered, remaining: 2 - answered, shown: 4, seconds: 10, finished: answered === 2,
  });
  await where.route("**/api/v1/participation**", async (route) => {
    const request = route.request();
    const path = request.url().split("/participation")[1]!;
    if (request.postData() !== null) sent.push(request.postDataJSON());
    if (path === "/link") {
      return route.fulfill({ json: { title: "Walks", consent_text: "One line.\nAnother.", clips: 2, trials: 2, shown: 4, seconds: 10 } });
    }
    if (path === "" && request.method() === "POST") return route.fulfill({ status: 201, json: { token: "mareyparticipant_a_b" } });
    if (path === "" && request.method() === "DELETE") return route.fulfill({ status: 204 });
    if (path === "/trials") {
      return route.fulfill({ json: { ...state(), trial: { number: 1, clips: [0, 1, 1, 0], seconds_left: 10 } } });
    }
    if (path.startsWith("/trials/")) {
      answered += 1;
      return route.fulfill({ json: { outcome: "answered", ...state() } });
    }
    const [, number, part] = /^\/clips\/(\d)\/(\w+)$/.exec(path) ?? [];
    if (part === undefined) return route.fulfill({ json: state() });
    return route.fulfill({ response: await context.request.get(await addressOf(server, clips[Number(number)]!, part), {
      headers: { Accept: request.headers()["accept"]! },
    }) });
  });
  return sent;
}

/** Return the address of a part of a clip of the project, or of its skeleton. */
async function addressOf(server: string, [project, item]: [string, string], part: string): Promise<string> {
  const motion = `${server}projects/${project}/clips/${item}/parts/motion`;
  if (part === "motion") return motion;
  const { skeleton } = (await (await context.request.get(`${motion}?frames=0:1`)).json()) as { skeleton: { item: string } };
  return `${server}projects/${project}/skeletons/${skeleton.item}/parts/${part}`;
}
