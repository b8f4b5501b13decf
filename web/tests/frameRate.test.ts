import { expect, it } from "vitest";
import { FrameRate } from "../src/study/frameRate";

it.each([240, 60, 12])("knows the rate of a screen with %i pictures a second after at most two seconds and a bit", (hertz) => {
  const rate = new FrameRate();
  for (let frame = 0; frame < 2.1 * hertz; frame++) rate.note(1 / hertz);
  expect(rate.isKnown).toBe(true);
  expect(rate.rate).toBeCloseTo(hertz);
  rate.restart();
  expect(rate.isKnown).toBe(false);
});
