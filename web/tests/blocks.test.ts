import { describe, expect, it } from "vitest";
import { decodeBlocks } from "../src/wire/blocks";
import { bytesOf, INDEX } from "./cases";

describe("arrays in blocks", () => {
  it.each(Object.entries(INDEX.arrays))("%s has the same bits as the array that was stored", (name, shape) => {
    const decoded = decodeBlocks(bytesOf(`${name}.blocks`));
    expect(decoded.shape).toEqual(shape);
    const bits = new Uint8Array(decoded.values.buffer);
    expect(Buffer.compare(bits, bytesOf(`${name}.f4`))).toBe(0);
  });

  it("refuses bytes that are cut off, and never hangs or returns half an array", () => {
    const whole = bytesOf("walk.blocks");
    for (let length = 0; length < whole.length; length += 997) {
      expect(() => decodeBlocks(whole.subarray(0, length)), `${length} bytes`).toThrow();
    }
  });

  it("refuses a header with a changed byte", () => {
    const whole = bytesOf("odd.blocks");
    for (let at = 0; at < 44; at++) {
      const damaged = whole.slice();
      damaged[at]! ^= 0x11;
      expect(() => decodeBlocks(damaged), `byte ${at}`).toThrow();
    }
  });
});
