/** Keys of the viewer: a table of their actions, from which the help is made, too. */

export type Action =
  | "play" | "back" | "forward" | "back10" | "forward10" | "start" | "end" | "slower" | "faster"
  | "look" | "layout" | "follow" | "frame" | "camera" | "turnLeft" | "turnRight" | "nearer" | "farther" | "help";

interface Key {
  action: Action;
  key: string;
  /** Another key with the same action. */
  also?: string;
  shift?: boolean;
  shown: string;
  text: string;
}

export const KEYS: Key[] = [
  { action: "play", key: " ", shown: "Space", text: "Play or pause" },
  { action: "back", key: "ArrowLeft", shown: "←", text: "One frame back" },
  { action: "forward", key: "ArrowRight", shown: "→", text: "One frame forward" },
  { action: "back10", key: "ArrowLeft", shift: true, shown: "Shift ←", text: "Ten frames back" },
  { action: "forward10", key: "ArrowRight", shift: true, shown: "Shift →", text: "Ten frames forward" },
  { action: "start", key: "Home", shown: "Home", text: "Go to the start" },
  { action: "end", key: "End", shown: "End", text: "Go to the end" },
  { action: "slower", key: "-", shown: "−", text: "Play slower" },
  { action: "faster", key: "=", also: "+", shown: "+", text: "Play faster" },
  { action: "look", key: "v", shown: "V", text: "Switch between skeleton and mannequin" },
  { action: "layout", key: "b", shown: "B", text: "Show the clips side by side or overlaid, or show one of two clips" },
  { action: "camera", key: "c", shown: "C", text: "Camera from the front, the left side or the top" },
  { action: "turnLeft", key: "a", shown: "A", text: "Move the camera around the figure, to the left" },
  { action: "turnRight", key: "d", shown: "D", text: "Move the camera around the figure, to the right" },
  { action: "nearer", key: "w", shown: "W", text: "Move the camera nearer" },
  { action: "farther", key: "s", shown: "S", text: "Move the camera farther away" },
  { action: "frame", key: "f", shown: "F", text: "Bring the figure back into view" },
  { action: "follow", key: "f", shift: true, shown: "Shift F", text: "Start or stop following the figure with the camera" },
  { action: "help", key: "?", shown: "?", text: "Show this help" },
];

/** Return the action of a key press, or null if the press is for something else. */
export function actionOf(event: KeyboardEvent): Action | null {
  if (event.ctrlKey || event.metaKey || event.altKey || event.isComposing) return null;
  const target = event.target as HTMLElement | null;
  const typed = event.key.length === 1 ? event.key.toLowerCase() : event.key;
  if (target?.closest("select, textarea, dialog") || (typed === " " && target?.closest("button, a, summary"))) return null;
  const shift = event.shiftKey && (typed.length > 1 || /[a-z]/.test(typed)); // signs such as ? and = need Shift on some keyboards
  return KEYS.find((one) => [one.key, one.also].includes(typed) && (one.shift ?? false) === shift)?.action ?? null;
}
