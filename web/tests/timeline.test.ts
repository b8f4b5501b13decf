import { expect, it } from "vitest";
import { Timeline } from "../src/player/timeline";

const short = { duration: 2.3, frameRate: 30 };
const long = { duration: 6.7, frameRate: 120 };

it.each([
  ["a short clip before a long one", [short, long], 201],
  ["a long clip before a short one", [long, short], 804],
  ["one clip", [short], 69],
  ["no clip", [], 1],
])("reaches the end of %s", (_, clips, frames) => {
  const timeline = new Timeline(clips);
  expect(timeline.frames).toBe(frames);
  const end = timeline.secondsAt(Infinity);
  expect(timeline.frameAt(end)).toBe(frames - 1);
  expect(timeline.duration - end).toBeLessThan(1 / (clips[0]?.frameRate ?? 1) + 1e-9);
});

it("finds each frame again at its time", () => {
  const timeline = new Timeline([{ duration: 7, frameRate: 29.97 }]);
  for (let frame = 0; frame < timeline.frames; frame++) expect(timeline.frameAt(timeline.secondsAt(frame))).toBe(frame);
  expect([timeline.frameAt(-1), timeline.secondsAt(-5)]).toEqual([0, 0]);
});
