/** A real study in a real Chromium, seen by its participants and by those who carry it out.
 *
 * pytest compares what is recorded (tests/integration/test_pages.py).
 */
import { createHash } from "node:crypto";
import { readFileSync, writeFileSync } from "node:fs";
import { type Browser, type BrowserContext, type Page } from "playwright-core";
import { afterAll, beforeAll, expect, it } from "vitest";
import type { Differences } from "../src/study/conducting";
import type { Trial } from "../src/study/participation";
import { colours, faults, launch, PATIENCE_MS, picture, scene, signOut, tellFirstPose } from "./looking";

interface Given {
  chromium: string;
  /** Address of the page. */
  page: string;
  /** Codes of links: for a whole study, one to withdraw from, one of a slow computer, and one with a second per trial. */
  codes: Record<"whole" | "withdrawn" | "slow" | "hurried", string>;
  trials: number;
  /** Addresses of the page of the study, with codes that work once: for its owner and for a reader of the project. */
  conductor: string;
  reader: string;
  /** Root of the API, token of the owner, and path of the study. */
  api: string;
  token: string;
  study: string;
  item: string;
  /** Token of a worker, and the files of the analysis that it returns, by name. */
  worker: string;
  files: Record<string, string>;
  /** File for the answers that were given. */
  answers: string;
}

const GIVEN = JSON.parse(process.env["MAREY_WEB_GIVEN"]!) as Given;
const SMALL = { width: 480, height: 360 }; // four figures without a graphics processor
const SIZES = { 1280: { width: 1280, height: 800 }, 390: { width: 390, height: 844 } };

let browser: Browser;
/** The page of the study as its owner sees it, open while participants answer. */
let owner: { context: BrowserContext; page: Page };
const complaints: string[] = [];

beforeAll(async () => {
  browser = await launch(GIVEN.chromium);
  owner = await profile(SIZES[1280]);
  await owner.page.goto(GIVEN.conductor.replace("#", "&test=1#"));
});

afterAll(() => browser.close());

/** Return a new profile of the browser, which shares nothing with the others. */
async function profile(viewport = SMALL): Promise<{ context: BrowserContext; page: Page }> {
  const context = await browser.newContext({ viewport, colorScheme: "dark" });
  context.setDefaultTimeout(PATIENCE_MS);
  const page = await context.newPage();
  page.on("pageerror", (error) => complaints.push(error.message));
  return { context, page };
}

function open(page: Page, code: string, rate = 60): Promise<unknown> {
  return page.goto(`${GIVEN.page}?test=1&rate=${rate}#${code}`);
}

/** Give consent, and wait until all motions are loaded. */
async function begin(page: Page, code: string): Promise<void> {
  await open(page, code);
  await page.getByRole("button", { name: "I agree, begin" }).click();
  await page.getByRole("button", { name: "Next (Space)" }).waitFor();
}

/** Do what opens a trial, and return the trial that the server opened, which the page may not show yet. */
async function openedBy(page: Page, work: () => Promise<unknown>): Promise<Trial> {
  const opened = page.waitForResponse((answer) => answer.url().endsWith("/participation/trials"));
  await work();
  return ((await (await opened).json()) as { trial: Trial }).trial;
}

/** Do what opens a trial, wait until the page shows it, and return it. */
async function trialAfter(page: Page, work: () => Promise<unknown>): Promise<Trial> {
  const trial = await openedBy(page, work);
  await page.getByRole("button", { name: "Figure 4" }).waitFor();
  return trial;
}

async function pictures(page: Page, name: string): Promise<void> {
  for (const [width, size] of Object.entries(SIZES)) {
    if (process.env["MAREY_WEB_PICTURES"] === undefined) return;
    await page.setViewportSize(size);
    await picture(page, `study-${name}-${width}`);
  }
  await page.setViewportSize(SMALL);
}

/** Take pictures of the page of the study at both sizes, in the dark and the light theme. */
async function portraits(page: Page, name: string): Promise<void> {
  if (process.env["MAREY_WEB_PICTURES"] === undefined) return;
  for (const theme of ["dark", "light"]) {
    for (const [width, size] of Object.entries(SIZES)) {
      await page.setViewportSize(size);
      await page.waitForTimeout(300); // for the size and the theme
      await picture(page, `conductor-${name}-${theme}-${width}`, true);
    }
    await page.getByRole("button", { name: "Switch between dark and light" }).click();
  }
  await page.setViewportSize(SIZES[1280]);
}

async function ask<T>(method: string, path: string, body: unknown = undefined, token = GIVEN.token): Promise<T> {
  const type = body instanceof Uint8Array ? "application/octet-stream" : "application/json";
  const content = body instanceof Uint8Array ? new Blob([new Uint8Array(body)]) : JSON.stringify(body);
  const headers = { Authorization: `Bearer ${token}`, "Content-Type": type };
  const answer = await fetch(`${GIVEN.api}/${path}`, { method, headers, body: body === undefined ? null : content });
  const text = await answer.text();
  expect(answer.ok, `${path}: ${text}`).toBe(true);
  return (text === "" ? null : JSON.parse(text)) as T;
}

/** Analyse the study as a worker does. */
async function analyse(): Promise<void> {
  await ask("POST", "projects/lab/jobs", { kind: "analyse_study", inputs: { study: { item: GIVEN.item } } });
  const claim = { worker: "w", kinds: ["analyse_study"], max: 1 };
  const { leases } = await ask<{ leases: { job: string; fence: number; attempt_token: string }[] }>("POST", "leases", claim, GIVEN.worker);
  const { job, fence, attempt_token } = leases[0]!;
  const result: Record<string, { blob: string; size_bytes: number }> = {};
  for (const [name, file] of Object.entries(GIVEN.files)) {
    const content = readFileSync(file);
    const blob = `sha256:${createHash("sha256").update(content).digest("hex")}`;
    await ask("PUT", `blobs/${blob}`, content, attempt_token);
    result[name] = { blob, size_bytes: content.length };
  }
  await ask("POST", `jobs/${job}/attempts/${fence}/complete`, { write_id: "12345678", result }, attempt_token);
}

it("tells its owner that nobody has answered yet, and shows readers nothing of participants", async () => {
  await owner.page.getByText("Nobody has answered a trial yet").waitFor();
  await owner.page.getByText("There is no analysis of this revision yet").waitFor();
  await owner.page.getByRole("row", { name: /^p1 .*invited/ }).waitFor();
  expect(owner.page.url()).not.toContain("mareyview_");
  expect(await faults(owner.page)).toEqual([]);
  await portraits(owner.page, "empty");
  const { context, page } = await profile(SIZES[1280]);
  const asked: string[] = [];
  page.on("request", (request) => asked.push(request.url()));
  await page.goto(GIVEN.reader);
  await page.getByText("Only owners and maintainers of the project can see answers").waitFor();
  await page.getByText("I may stop at any time.").waitFor({ state: "attached" });
  expect(asked.filter((url) => /participants|differences|judgements/.test(url))).toEqual([]);
  expect(await faults(page)).toEqual([]);
  await portraits(page, "reader");
  await context.close();
});

it("records each trial that a participant answers, by keys and by clicks, also after a reload", async () => {
  const { context, page } = await profile();
  await open(page, GIVEN.codes.whole);
  await page.getByRole("heading", { name: "Walks" }).waitFor();
  expect(page.url()).not.toContain("mareystudy_");
  expect(await faults(page)).toEqual([]);
  await pictures(page, "consent");
  await page.keyboard.press("Tab");
  await page.keyboard.press("Enter");
  const answers: { number: number; shown: number[]; chosen: number[] }[] = [];
  for (let index = 0; index < GIVEN.trials; index++) {
    const left = GIVEN.trials - index;
    await page.locator(".count", { hasText: new RegExp(`^${left}$`) }).waitFor();
    if (index === 0) await pictures(page, "between");
    let trial = await trialAfter(page, () => page.keyboard.press("Space"));
    if (index === 1) {
      await page.keyboard.press("4"); // chosen before the reload: it does not count
      await page.reload();
      await page.getByRole("button", { name: "Next (Space)" }).waitFor();
      const again = await trialAfter(page, () => page.keyboard.press("Space"));
      expect(again).toEqual({ ...trial, seconds_left: again.seconds_left });
      expect(again.seconds_left).toBeLessThan(trial.seconds_left);
      trial = again;
    }
    if (index === 0) {
      await expect.poll(() => colours(page), { timeout: PATIENCE_MS }).toBeGreaterThan(15);
      expect(await faults(page)).toEqual([]);
      await page.keyboard.press("1");
      await pictures(page, "trial");
      await page.keyboard.press("1"); // taken back
    }
    const chosen = [index % 4, (index + 1 + (index % 3)) % 4].sort();
    if (index % 2 === 0) {
      for (const position of chosen) await page.keyboard.press(String(position + 1));
    } else {
      await page.getByRole("button", { name: `Figure ${chosen[1]! + 1}` }).dblclick();
      await page.getByRole("button", { name: `Figure ${chosen[0]! + 1}` }).dblclick();
    }
    answers.push({ number: trial.number, shown: trial.clips, chosen });
  }
  await page.getByRole("heading", { name: "Thank you" }).waitFor();
  await pictures(page, "finished");
  expect(await faults(page)).toEqual([]);
  await page.reload();
  await page.getByRole("heading", { name: "Thank you" }).waitFor();
  writeFileSync(GIVEN.answers, JSON.stringify(answers));
  await context.close();
});

it("refuses a link that another browser has used", async () => {
  const { context, page } = await profile();
  await open(page, GIVEN.codes.whole);
  await page.getByRole("button", { name: "I agree, begin" }).click();
  await page.getByText("This link is not valid").waitFor();
  expect(await page.getByRole("button", { name: "Reload" }).count()).toBe(0);
  expect(await faults(page)).toEqual([]);
  await pictures(page, "refused");
  await context.close();
});

it("deletes the answers of a participant who withdraws, and what this browser keeps", async () => {
  const { context, page } = await profile();
  await begin(page, GIVEN.codes.withdrawn);
  await trialAfter(page, () => page.keyboard.press("Space"));
  await page.keyboard.press("1");
  await page.keyboard.press("2");
  await page.getByRole("button", { name: "Withdraw" }).click();
  await page.getByRole("button", { name: "Delete my answers" }).click();
  await page.getByRole("heading", { name: "Your answers are deleted" }).waitFor();
  expect(await page.evaluate(() => localStorage.length)).toBe(0);
  await context.close();
});

it("says that the time is up, and shows other motions when the participant goes on", async () => {
  const { context, page } = await profile();
  await begin(page, GIVEN.codes.hurried);
  // The figures of a trial of one second may be gone before a busy machine could look for them.
  const first = await openedBy(page, () => page.keyboard.press("Space"));
  const told = (await page.getByText("The time was up").boundingBox())!;
  expect(told.x).toBeGreaterThanOrEqual(16); // not at the edge of the window
  await pictures(page, "late");
  const second = await openedBy(page, () => page.keyboard.press("Space"));
  expect([first.number, second.number]).toEqual([1, 2]);
  await context.close();
});

it("shows no trial on a computer that draws fewer than 30 pictures a second", async () => {
  const { context, page } = await profile();
  await open(page, GIVEN.codes.slow, 29);
  await page.getByRole("button", { name: "I agree, begin" }).click();
  await page.getByText("It shows 29 pictures per second").waitFor();
  expect(await faults(page)).toEqual([]);
  await pictures(page, "slow");
  await page.keyboard.press("Space");
  expect(await page.getByRole("button", { name: "Figure 1" }).count()).toBe(0);
  await context.close();
});

it("shows its owner what participants perceived, and both motions of a pair", async () => {
  const { page } = owner;
  await page.getByRole("row", { name: /^p1 .*finished/ }).waitFor(); // without a reload
  await page.getByRole("row", { name: /^p2 .*withdrawn .*deleted/ }).waitFor();
  const found = await ask<Differences>("GET", `${GIVEN.study}/differences?revision=1`);
  expect(found.trials).toBe(GIVEN.trials);
  const pairs = found.shown.flatMap((row, one) => row.slice(one + 1));
  const missing = pairs.filter((count) => count === 0).length;
  await page.getByText(missing === 0 ? "Every pair was shown." : `${missing} of ${pairs.length} pairs were never shown together.`).waitFor();
  await expect.poll(() => colours(page), { timeout: PATIENCE_MS }).toBeGreaterThan(15); // the picture of the table
  await page.getByText("All pairs as a table").click();
  const rows = page.getByRole("region", { name: "All pairs" }).getByRole("row");
  expect(await rows.count()).toBe(1 + pairs.length);
  expect((await rows.filter({ hasText: "missing" }).all()).length).toBe(missing);
  const nearest = Math.min(...found.differences.flatMap((row, one) => row.slice(one + 1)).filter((one) => one !== null));
  expect(await rows.nth(1).innerText()).toContain(nearest.toFixed(2));
  await rows.nth(1).getByRole("button").press("Enter");
  const shown = await scene(page, (one) => one.actors.length === 2);
  expect(shown.stage).toBe("webgl");
  expect(shown.triangles).toBeGreaterThan(1000);
  await tellFirstPose(page, "study, first pair", "marey-picked");
  expect(page.url()).toMatch(/left=\d+&right=\d+/);
  await page.getByRole("button", { name: /^1 / }).click();
  await scene(page, (one) => one.actors.length === 1);
  await tellFirstPose(page, "study, next motion", "marey-picked");
  await page.getByRole("combobox", { name: "Right" }).selectOption("2");
  await scene(page, (one) => one.actors.length === 2);
  expect(await faults(page)).toEqual([]);
  await page.getByText("All pairs as a table").click();
  await portraits(page, "results");
});

it("shows its owner the analysis, and ends the session by a button", async () => {
  const { context, page } = owner;
  await analyse();
  const report = page.getByRole("link", { name: "Report with figures" });
  await report.waitFor(); // until the page looks again
  await page.getByRole("region", { name: "Fitted metrics, best first" }).waitFor();
  expect(await page.getByRole("row", { name: /^positions, manhattan/ }).count()).toBe(1);
  const opened = await context.newPage();
  const answer = await opened.goto(new URL((await report.getAttribute("href"))!, page.url()).href);
  expect(answer!.status()).toBe(200);
  expect(answer!.headers()["content-security-policy"]).toContain("sandbox");
  await opened.getByText("Order and groups").first().waitFor();
  await picture(opened, "conductor-report");
  await opened.close();
  expect(await faults(page)).toEqual([]);
  await portraits(page, "analysed");
  await page.reload();
  await page.getByRole("row", { name: /^p1 .*finished/ }).waitFor();
  await scene(page, (one) => one.actors.length === 2); // the address holds the pair
  await signOut(page, context);
  expect(complaints).toEqual([]);
});
