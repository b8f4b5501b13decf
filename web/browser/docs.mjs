/** Look at the documentation page of the API in a real Chromium: `node docs.mjs CHROMIUM ADDRESS TOKEN [FOLDER]`.
 *
 * Writes one line of JSON with what was found, and pictures of the page into FOLDER.
 */
import { chromium } from "playwright-core";

const [executablePath, address, token, folder] = process.argv.slice(2);
const args = ["--no-sandbox", "--disable-dev-shm-usage", "--disable-gpu", "--no-first-run"];
const browser = await chromium.launch({ executablePath, args });
const found = { widths: {}, errors: [] };
for (const width of [390, 1280]) {
  for (const colorScheme of ["light", "dark"]) {
    const context = await browser.newContext({ viewport: { width, height: 900 }, colorScheme });
    const page = await context.newPage();
    page.on("pageerror", (error) => found.errors.push(String(error)));
    page.on("console", (message) => message.type() === "error" && found.errors.push(message.text()));
    await page.goto(`${address}/api/v1/docs`);
    await page.fill("#token", token);
    const operation = page.locator("#get_me_resource");
    await operation.locator("summary").first().click();
    await operation.locator(".try summary").click();
    await operation.locator("button").click();
    await operation.locator(".try pre", { hasText: "200" }).waitFor();
    found.answer = await operation.locator(".try pre").textContent();
    const create = page.locator("#post_projects");
    await create.locator("summary").first().click();
    await create.locator(".try summary").click();
    if (folder) {
      await create.scrollIntoViewIfNeeded();
      await page.screenshot({ path: `${folder}/docs-${width}-${colorScheme}.png` });
      await page.evaluate(() => scrollTo(0, 0));
      await page.screenshot({ path: `${folder}/docs-top-${width}-${colorScheme}.png` });
    }
    if (colorScheme === "light") {
      await page.evaluate(() => document.querySelectorAll("details").forEach((one) => { one.open = true; }));
      found.widths[width] = await page.evaluate(() => document.documentElement.scrollWidth);
    }
    found.methods = await page.evaluate(() =>
      Object.fromEntries(["get", "post", "put", "patch", "delete"].map((name) => [name, getComputedStyle(document.querySelector(`.method.${name}`)).color])));
    found.kept = await page.evaluate(() => [location.href, document.cookie, localStorage.length + sessionStorage.length]);
    await page.reload();
    found.afterReload = await page.inputValue("#token");
    await context.close();
  }
}
await browser.close();
process.stdout.write(JSON.stringify(found));
