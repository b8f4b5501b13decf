/** A participant of a real study in a real Chromium; pytest compares what is recorded (tests/integration/test_pages.py). */
import { writeFileSync } from "node:fs";
import { type Browser, type BrowserContext, type Page } from "playwright-core";
import { afterAll, beforeAll, expect, it, vi } from "vitest";
import type { Trial } from "../src/study/participation";
import { colours, faults, launch, picture } from "./looking";

interface Given {
  chromium: string;
  /** Address of the page. */
  page: string;
  /** Codes of links: for a whole study, one to withdraw from, one of a slow computer, and one with a second per trial. */
  codes: Record<"whole" | "withdrawn" | "slow" | "hurried", string>;
  trials: number;
  /** File for the answers that were given. */
  answers: string;
}

const GIVEN = JSON.parse(process.env["MAREY_WEB_GIVEN"]!) as Given;
const SMALL = { width: 480, height: 360 }; // four figures without a graphics processor
const SIZES = { 1280: { width: 1280, height: 800 }, 390: { width: 390, height: 844 } };

vi.setConfig({ testTimeout: 180_000 });

let browser: Browser;
const complaints: string[] = [];

beforeAll(async () => {
  browser = await launch(GIVEN.chromium);
});

afterAll(() => browser.close());

/** Return a new profile of the browser, which shares nothing with the others. */
async function profile(): Promise<{ context: BrowserContext; page: Page }> {
  const context = await browser.newContext({ viewport: SMALL, colorScheme: "dark" });
  context.setDefaultTimeout(60_000); // machines may be busy
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
      expect(await colours(page)).toBeGreaterThan(15);
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
  await page.getByRole("button", { name: "Delete them" }).click();
  await page.getByText("Your answers are deleted").waitFor();
  expect(await page.evaluate(() => localStorage.length)).toBe(0);
  await context.close();
});

it("says that the time is up, and shows other motions when the participant goes on", async () => {
  const { context, page } = await profile();
  await begin(page, GIVEN.codes.hurried);
  // The figures of a trial of one second may be gone before a busy machine could look for them.
  const first = await openedBy(page, () => page.keyboard.press("Space"));
  await page.getByText("The time was up").waitFor();
  await pictures(page, "late");
  const second = await openedBy(page, () => page.keyboard.press("Space"));
  expect([first.number, second.number]).toEqual([1, 2]);
  await context.close();
});

it("shows no trial on a computer that draws fewer than 30 pictures a second", async () => {
  const { context, page } = await profile();
  await open(page, GIVEN.codes.slow, 29);
  await page.getByRole("button", { name: "I agree, begin" }).click();
  await page.getByText("It shows 29 pictures a second").waitFor();
  expect(await faults(page)).toEqual([]);
  await pictures(page, "slow");
  await page.keyboard.press("Space");
  expect(await page.getByRole("button", { name: "Figure 1" }).count()).toBe(0);
  await context.close();
  expect(complaints).toEqual([]);
});
