/** What pointers, the wheel and the keyboard ask for, without the page. */

const LINE = 24; // pixels of a line, for wheels that count lines
const FAR = 0.15; // of the width of the canvas, by which an arrow key moves the photograph
const TOOLS = { b: "added", e: "removed", s: "object" }; // what the tools draw, by their keys
const ARROWS = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };

/**
 * The pointers that are down on the canvas, and what they do together.
 *
 * One pointer draws, unless it is the middle button or there is no brush, and moves the photograph then. Two of them move
 * and zoom it. When one of two is lifted, the other one does nothing until it is lifted, too.
 */
export class Gestures {
  #pointers = new Map(); // by their numbers: where they are
  #kind = null; // or "pan", "pinch", "done"

  /** Whether the pointers do something other than draw. */
  get isTaken() {
    return this.#kind !== null;
  }

  /** Put a pointer down. Returns true if it ends a stroke that another one has begun. */
  down(pointer, hasBrush) {
    this.#pointers.set(pointer.id, { x: pointer.x, y: pointer.y });
    if (this.#pointers.size > 1) {
      const endsStroke = this.#kind === null;
      this.#kind = "pinch";
      return endsStroke;
    }
    if (pointer.button === 1 || (pointer.button === 0 && !hasBrush)) {
      this.#kind = "pan";
    }
    return false;
  }

  /** Move a pointer. Returns how far the photograph moves, and the factor and the point of a zoom, or null. */
  move(pointer) {
    const last = this.#pointers.get(pointer.id);
    if (!last) {
      return null;
    }
    if (pointer.buttons === 0) {
      this.#pointers.delete(pointer.id);
      this.#kind = null;
      return null;
    }
    const before = this.#pair();
    this.#pointers.set(pointer.id, { x: pointer.x, y: pointer.y });
    if (this.#kind === "pan") {
      return { right: pointer.x - last.x, down: pointer.y - last.y, zoom: null };
    }
    if (this.#kind === "pinch" && before) {
      const after = this.#pair();
      const zoom = { factor: after.apart / before.apart, x: before.x, y: before.y };
      return { right: after.x - before.x, down: after.y - before.y, zoom };
    }
    return this.#kind === null ? null : { right: 0, down: 0, zoom: null };
  }

  /** Lift a pointer. Returns whether it did something other than draw. */
  up(pointer) {
    if (!this.#pointers.delete(pointer.id) || this.#kind === null) {
      return false;
    }
    this.#kind = this.#pointers.size === 0 ? null : "done";
    return true;
  }

  /** The middle of the first two pointers, and how far they are apart; null if there are fewer. */
  #pair() {
    const [a, b] = this.#pointers.values();
    return b ? { x: (a.x + b.x) / 2, y: (a.y + b.y) / 2, apart: Math.hypot(a.x - b.x, a.y - b.y) || 1 } : null;
  }
}

/** By which factor an event of the wheel zooms; a pinch on a touchpad is one with `ctrlKey`. */
export function wheelFactor({ deltaY, deltaMode, ctrlKey }) {
  const pixels = deltaY * (deltaMode === 1 ? LINE : 1);
  return Math.exp(-pixels * (ctrlKey ? 0.01 : 0.002));
}

/** What a key asks for, as the name of an action with its arguments, or null; `width` is that of the canvas. */
export function actionOfKey(key, width) {
  switch (key.toLowerCase()) {
    case "+":
    case "=":
      return ["step", 1];
    case "-":
    case "_":
      return ["step", -1];
    case "0":
      return ["fit"];
    case "1":
      return ["full"];
    case " ":
      return ["hand", true];
    case "o":
    case "\\":
      return ["original", true];
    default:
      if (Object.hasOwn(TOOLS, key.toLowerCase())) {
        return ["tool", TOOLS[key.toLowerCase()]];
      }
      return Object.hasOwn(ARROWS, key) ? ["pan", ...ARROWS[key].map((share) => share * FAR * width)] : null;
  }
}
