/** Colours of numbers: viridis, which people with any colour vision can order. */

const STOPS = ["#440154", "#472d7b", "#3b528b", "#2c728e", "#21918c", "#28ae80", "#5ec962", "#addc30", "#fde725"];

/** The colours from 0 to 1, for a gradient of CSS. */
export const GRADIENT = STOPS.join(", ");

/** Return the colour of a number from 0 to 1. */
export function colourOf(value: number): string {
  const place = Math.min(Math.max(value, 0), 1) * (STOPS.length - 1);
  const index = Math.min(Math.floor(place), STOPS.length - 2);
  const [from, to] = [channels(STOPS[index]!), channels(STOPS[index + 1]!)];
  const mixed = from.map((one, channel) => Math.round(one + (place - index) * (to[channel]! - one)));
  return `rgb(${mixed.join(" ")})`;
}

function channels(hexadecimal: string): number[] {
  return [1, 3, 5].map((at) => parseInt(hexadecimal.slice(at, at + 2), 16));
}
