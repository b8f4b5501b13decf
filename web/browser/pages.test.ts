/** The pages in a real Chromium, against a real server that pytest has started and filled (tests/integration/test_pages.py). */
import { type Browser, type BrowserContext, type Page } from "playwright-core";
import { afterAll, beforeAll, expect, it } from "vitest";
import type { SceneState } from "../src/player/testHandle";
import { colours, faults, launch, PATIENCE_MS, picture, scene, signOut, smallTargets, tellFirstPose } from "./looking";

interface Given {
  chromium: string;
  /** Address of the page that shows two clips, with a code that works once. */
  link: string;
  /** Positions of joints in metres that the server computes, by frame of the first clip. */
  positions: Record<string, number[]>;
  clips: string[];
}

const GIVEN = JSON.parse(process.env["MAREY_WEB_GIVEN"]!) as Given;
const TOLERANCE_M = 1e-4;
/** Draw calls of one figure: ground, its lines twice, limbs and balls with their shadows, path, and marks of four feet. */
const MOST_CALLS = 3 + 4 + 1 + 4;
const MOST_TRIANGLES = 30_000;

let browser: Browser;
let context: BrowserContext;
let page: Page;
/** Direction from which the camera sees the first clip from the front, in degrees about the vertical. */
let front = 0;
const complaints: string[] = [];

/** Return the direction that a body faces, in degrees about the vertical from +z, by the positions of its hips. */
function frontOf(actor: SceneState["actors"][number]): number {
  const place = (name: RegExp) => 3 * actor.joints.findIndex((joint) => name.test(joint));
  const [left, right] = [place(/^(Left|l)(UpLeg|Thigh)$/), place(/^(Right|r)(UpLeg|Thigh)$/)]; // real takes, and generated ones
  const [x, z] = [0, 2].map((axis) => actor.positions[left + axis]! - actor.positions[right + axis]!) as [number, number];
  return (Math.atan2(-z, x) * 180) / Math.PI;
}

beforeAll(async () => {
  browser = await launch(GIVEN.chromium);
  context = await browser.newContext({ viewport: { width: 1280, height: 800 }, colorScheme: "dark" });
  context.setDefaultTimeout(PATIENCE_MS);
  page = await context.newPage();
  page.on("console", (message) => message.type() === "error" && complaints.push(message.text()));
  page.on("pageerror", (error) => complaints.push(error.message));
  await page.goto(`${GIVEN.link.replace("#", "&test=1#")}`);
});

afterAll(() => browser.close());

it("draws both clips with WebGL, with every joint where the server computes it", async () => {
  let state = await scene(page, (one) => one.actors.length === 2);
  expect(state.stage).toBe("webgl");
  expect(state.actors.map((actor) => actor.name)).toEqual(GIVEN.clips);
  await tellFirstPose(page, "view, cold");
  expect(state.calls).toBeGreaterThan(4);
  expect(state.calls).toBeLessThanOrEqual(2 * MOST_CALLS);
  expect(state.triangles).toBeGreaterThan(1000);
  expect(state.triangles).toBeLessThanOrEqual(2 * MOST_TRIANGLES);
  for (const [frame, expected] of Object.entries(GIVEN.positions)) {
    await page.getByRole("slider", { name: "Frame" }).fill(frame);
    state = await scene(page, (one) => one.actors[0]!.frame === Number(frame));
    const errors = state.actors[0]!.positions.map((value, at) => Math.abs(value - expected[at]!));
    expect(errors.length).toBe(expected.length);
    expect(Math.max(...errors), `frame ${frame}`).toBeLessThan(TOLERANCE_M);
  }
  await expect.poll(() => colours(page), { timeout: PATIENCE_MS }).toBeGreaterThan(30);
  await picture(page, "view-mannequins");
});

it("works with keys alone, and keeps all that is seen in its address, but not the code", async () => {
  expect(page.url()).not.toContain("mareyview_");
  await page.keyboard.press("Home");
  await page.keyboard.press("Shift+ArrowRight");
  await page.keyboard.press("ArrowLeft");
  await page.keyboard.press("v");
  await page.keyboard.press("c");
  let state = await scene(page, (one) => one.actors[0]!.frame === 9 && one.camera.split(",")[1] === "8");
  front = Number(state.camera.split(",")[0]);
  expect(frontOf(state.actors[0]!)).toBeCloseTo(front, 0);
  await page.keyboard.press("d");
  state = await scene(page, (one) => one.camera !== state.camera);
  await page.keyboard.press("a");
  await page.keyboard.press("w");
  await page.keyboard.press("s");
  await scene(page, (one) => one.camera === `${front},8,3`);
  await page.keyboard.press("Space");
  await scene(page, (one) => one.seconds > 0.3);
  await page.keyboard.press("Space");
  await page.keyboard.press("Home");
  await page.keyboard.press("ArrowRight");
  await expect.poll(() => page.url(), { timeout: PATIENCE_MS }).toMatch(new RegExp(`frame=1&camera=${front},8,3&look=skeleton`));
  await picture(page, "view-skeletons");
});

it("copies a link to the frame that is shown, or says what to copy", async () => {
  await context.grantPermissions(["clipboard-read", "clipboard-write"]);
  await page.keyboard.press("End");
  await page.getByRole("button", { name: "Copy link" }).click(); // before the address is written
  await page.getByRole("button", { name: "Copied" }).waitFor();
  const last = (await page.getByRole("slider", { name: "Frame" }).getAttribute("max"))!;
  expect(await page.evaluate(() => navigator.clipboard.readText())).toBe(page.url());
  expect(page.url()).toContain(`frame=${last}&`);
  await page.evaluate(() => Object.defineProperty(navigator, "clipboard", { value: undefined })); // as without HTTPS
  await page.getByRole("button", { name: "Copy link" }).click();
  await page.getByRole("button", { name: "Copy the page’s address" }).waitFor();
  await page.keyboard.press("Home");
  await page.keyboard.press("ArrowRight");
  await expect.poll(() => page.url(), { timeout: PATIENCE_MS }).toContain("frame=1&");
});

it("shows the same again from the copied address, in a narrow window, with the cookie alone", async () => {
  const phone = await browser.newContext({
    viewport: { width: 390, height: 844 }, isMobile: true, hasTouch: true, storageState: await context.storageState(),
  });
  const narrow = await phone.newPage();
  await narrow.goto(page.url());
  const state = await scene(narrow, (one) => one.actors.length === 2);
  expect([state.actors[0]!.frame, state.camera]).toEqual([1, `${front},8,3`]);
  expect(await narrow.evaluate(() => document.cookie)).toBe(""); // pages cannot read the cookie
  expect(await narrow.evaluate(() => document.documentElement.scrollWidth)).toBeLessThanOrEqual(390);
  expect(await smallTargets(narrow)).toEqual([]);
  await picture(narrow, "view-390");
  await phone.close();
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
  await expect.poll(() => colours(plain), { timeout: PATIENCE_MS }).toBeGreaterThan(5);
  const notice = await plain.getByText("This browser offers no WebGL").boundingBox();
  const drawing = (await plain.locator("canvas").boundingBox())!;
  expect(notice!.y).toBeGreaterThanOrEqual(drawing.y + drawing.height - 1); // it covers no figure
  await picture(plain, "view-without-webgl");
  await plain.close();
});

it("says to a browser with a session which clip there is not", async () => {
  const gone = await context.newPage();
  const { searchParams } = new URL(page.url());
  await gone.goto(new URL(`view?clip=${searchParams.get("clip")!.split("/")[0]}/clip_none`, page.url()).href);
  await gone.getByRole("heading", { name: "The clip cannot be shown" }).waitFor();
  await gone.getByText("clip_none").waitFor();
  await gone.close();
});

it("says what to do without a session, and for a link that was used", async () => {
  const stranger = await browser.newContext({ viewport: { width: 1280, height: 800 } });
  stranger.setDefaultTimeout(PATIENCE_MS);
  const other = await stranger.newPage();
  await other.goto(GIVEN.link); // its code was used above
  await other.getByText("This link is not valid").waitFor();
  expect(await other.evaluate(() => document.documentElement.scrollHeight)).toBe(800); // nothing to scroll to
  await other.goto(page.url());
  await other.getByText("marey view PROJECT/CLIP --browser").waitFor();
  expect(await faults(other)).toEqual([]);
  await picture(other, "view-without-link");
  await other.goto(new URL("/s/", page.url()).href);
  await other.getByText("This address names no study").waitFor();
  expect(await faults(other)).toEqual([]);
  await stranger.close();
});

it("ends the session by a button", () => signOut(page, context));
