/** Reports in a real Chromium: pages of every kind on a phone and on a desk, and the motion that they play. */
import { readFileSync } from "node:fs";
import { type Browser, type BrowserContextOptions, chromium, type Page } from "playwright-core";
import { afterAll, beforeAll, expect, it } from "vitest";
import { COLOUR_RULES, faults, FINGER_PX, launch, PATIENCE_MS, picture, shownColours } from "./looking";

interface Given {
  chromium: string;
  /** Address of the folder with a page for each name, and `played`: the report of an evaluation with the player. */
  folder: string;
  names: string[];
  /** Page as a server has sent it, with its content security policy. */
  served: { file: string; policy: string };
}

const GIVEN = JSON.parse(process.env["MAREY_WEB_GIVEN"]!) as Given;
const WIDTHS = [390, 1280];
const HINT = "Scroll sideways";

let browser: Browser;

beforeAll(async () => {
  browser = await launch(GIVEN.chromium);
});

afterAll(() => browser.close());

async function opened(name: string, width: number, options: BrowserContextOptions = {}): Promise<Page> {
  const context = await browser.newContext({ viewport: { width, height: 844 }, ...options });
  context.setDefaultTimeout(PATIENCE_MS);
  const page = await context.newPage();
  page.on("pageerror", (error) => expect.fail(`${name}: ${error.message}`));
  page.on("request", (request) => {
    if (!request.url().startsWith("data:") && !request.url().startsWith(GIVEN.folder)) expect.fail(request.url());
  });
  await page.goto(`${GIVEN.folder}/${name}.html`);
  return page;
}

/** Return by how much the page is wider than the window, and the boxes whose content is cut off without a way to scroll. */
const tooWide = (page: Page) =>
  page.evaluate(() => {
    const root = document.scrollingElement!;
    const cut = [...document.querySelectorAll("header *, main *")].filter((one) => {
      const right = one.getBoundingClientRect().right;
      return right > innerWidth + 1 && one.closest("figure > div, .table") === null;
    });
    return { beyond: Math.max(root.scrollWidth - innerWidth, 0), cut: cut.map((one) => one.outerHTML.slice(0, 80)) };
  });

/** Check that the report fits the window in light and in dark colours. */
async function fitsInEveryColour(page: Page, name: string): Promise<void> {
  for (const colorScheme of ["light", "dark"] as const) {
    await page.emulateMedia({ colorScheme });
    expect(await tooWide(page), `${name} in ${colorScheme}`).toEqual({ beyond: 0, cut: [] });
    await picture(page, `report-${name}-${page.viewportSize()!.width}-${colorScheme}`, true);
  }
}

it.each([...GIVEN.names, "played"])("shows the report %s on a phone, without a fault and for fingers", async (name) => {
  const page = await opened(name, 390, { hasTouch: true, isMobile: true });
  expect(await hints(page)).toEqual([]);
  const small = await page.evaluate((least) =>
    [...document.querySelectorAll<HTMLElement>("nav a, summary, button")]
      .filter((one) => one.checkVisibility() && Math.min(one.offsetHeight, one.offsetWidth) < least)
      .map((one) => `${one.innerText}: ${one.offsetWidth} x ${one.offsetHeight}`), FINGER_PX);
  expect(small).toEqual([]);
  await fitsInEveryColour(page, name); // and is dark now
  expect(await faults(page, COLOUR_RULES)).toEqual([]);
  await page.emulateMedia({ colorScheme: "light" });
  expect(await faults(page)).toEqual([]);
  await page.context().close();
});

it.each(GIVEN.names)("shows the tables of the report %s in columns that can be read on a phone", async (name) => {
  const page = await opened(name, 390, { isMobile: true });
  const found = await page.evaluate(() => {
    const shown = (what: string) => [...document.querySelectorAll<HTMLElement>(what)].filter((one) => one.checkVisibility());
    const gap = (one: HTMLElement) => one.getBoundingClientRect().top - one.previousElementSibling!.getBoundingClientRect().bottom;
    return {
      narrow: shown("td.prose").filter((one) => one.offsetWidth < 200).map((one) => one.innerText),
      wide: shown("thead th").filter((one) => Math.max(one.offsetWidth, one.scrollWidth) > 390).map((one) => one.innerText),
      touching: shown(".table + p, .table + ul").filter((one) => gap(one) < 8).map((one) => one.innerText),
    };
  });
  expect(found).toEqual({ narrow: [], wide: [], touching: [] });
  await page.context().close();
});

/** Return the boxes that scroll and have no hint, and those that have one and do not scroll. */
async function hints(page: Page): Promise<string[]> {
  const boxes = await page.evaluate(() =>
    [...document.querySelectorAll("figure > div, .table")]
      .filter((one) => one.checkVisibility())
      .map((one) => ({
        scrolls: one.scrollWidth > one.clientWidth + 1,
        hint: getComputedStyle(one, "::before").content,
        html: one.outerHTML.slice(0, 80),
      })),
  );
  expect(boxes.length).toBeGreaterThan(0);
  expect(boxes.find(({ scrolls }) => scrolls)!.hint).toContain(HINT);
  return boxes.filter(({ scrolls, hint }) => scrolls !== (hint !== "none")).map(({ html }) => html);
}

it.each(GIVEN.names)("shows the report %s on a desk and on paper", async (name) => {
  const page = await opened(name, 1280);
  await fitsInEveryColour(page, name);
  await page.setViewportSize({ width: 794, height: 844 });
  await page.emulateMedia({ media: "print", colorScheme: "light" });
  expect(await tooWide(page)).toEqual({ beyond: 0, cut: [] });
  await picture(page, `report-${name}-print`, true);
  await page.context().close();
});

it.each(GIVEN.names)("shows the report %s without its script", async (name) => {
  const page = await opened(name, 390, { javaScriptEnabled: false });
  for (const text of ["lab on https://marey.example", "rita", "2026-11-29 14:05 UTC"]) {
    expect(await page.locator("header").innerText()).toContain(text);
  }
  expect(await page.locator("figure svg").first().isVisible()).toBe(true);
  expect(await page.locator(".player button").count()).toBe(0);
  await page.context().close();
});

it("offers no player in a page into which none was inserted", async () => {
  const page = await opened("evaluation", 390);
  expect(await page.locator(".player").count()).toBe(2);
  expect(await page.getByRole("button", { name: /Play/ }).count()).toBe(0);
  await page.context().close();
});

it("jumps to a chapter without motion for people who want none", async () => {
  const page = await opened("evaluation", 390);
  const behaviour = () => page.evaluate(() => getComputedStyle(document.documentElement).scrollBehavior);
  expect(await behaviour()).toBe("smooth");
  await page.emulateMedia({ reducedMotion: "reduce" });
  expect(await behaviour()).toBe("auto");
  await page.context().close();
});

/** Least number of colours of a picture with a lit mannequin; a picture without one has the few of buttons and texts. */
const LIT = 300;

/** Start the first trial; return what runs in its frame. */
async function playing(page: Page) {
  expect(await page.locator("iframe").count()).toBe(0); // nothing runs before somebody asks for it
  await page.getByRole("button", { name: /Play \d+ s of the worst trial/ }).click();
  const handle = await page.locator("iframe").elementHandle();
  const frame = (await handle!.contentFrame())!;
  await frame.getByRole("button", { name: "Pause" }).waitFor();
  return frame;
}

it("plays the worst trial from disk, beside the desired path", async () => {
  for (const width of WIDTHS) {
    const page = await opened("played", width);
    const frame = await playing(page);
    await expect.poll(() => shownColours(frame.locator("canvas").last()), { timeout: PATIENCE_MS }).toBeGreaterThan(LIT);
    const position = () => frame.locator("footer .position").innerText();
    const before = await position();
    await expect.poll(position, { timeout: PATIENCE_MS }).not.toBe(before);
    expect(await tooWide(page)).toEqual({ beyond: 0, cut: [] });
    expect(await page.getByRole("img", { name: "Paths of the worst trial" }).isVisible()).toBe(true);
    await page.locator("#motion").scrollIntoViewIfNeeded();
    await picture(page, `report-playing-${width}`);
    await page.context().close();
  }
});

it("plays a trial as the server sends the report, under its content security policy", async () => {
  const context = await browser.newContext({ viewport: { width: 1280, height: 844 } });
  context.setDefaultTimeout(PATIENCE_MS);
  const page = await context.newPage();
  const complaints: string[] = [];
  page.on("console", (message) => message.type() === "error" && complaints.push(message.text()));
  await page.route("**/*", (route) =>
    route.fulfill({
      body: readFileSync(GIVEN.served.file),
      headers: { "Content-Type": "text/html; charset=utf-8", "Content-Security-Policy": GIVEN.served.policy },
    }),
  );
  await page.goto("http://marey.example/report");
  const frame = await playing(page);
  await expect.poll(() => shownColours(frame.locator("canvas").last()), { timeout: PATIENCE_MS }).toBeGreaterThan(LIT);
  expect(complaints).toEqual([]);
  await context.close();
});

it("plays a trial without WebGL, seen from the side", async () => {
  const plain = await chromium.launch({ executablePath: GIVEN.chromium, args: ["--no-sandbox", "--disable-3d-apis"] });
  const context = await plain.newContext();
  context.setDefaultTimeout(PATIENCE_MS);
  const page = await context.newPage();
  await page.goto(`${GIVEN.folder}/played.html`);
  const frame = await playing(page);
  await frame.getByText("This browser offers no WebGL").waitFor();
  await expect.poll(() => shownColours(frame.locator("canvas").last()), { timeout: PATIENCE_MS }).toBeGreaterThan(10);
  await plain.close();
});
