/** The arithmetic of a frame: `[left, top, right, bottom]`, shares of the width and height of a picture. */

export const EDGES = ["left", "top", "right", "bottom"];
const LEAST = 0.01; // the least side of a frame, as a share of the picture

const clamp = (value, low, high) => Math.min(Math.max(value, low), high);

/**
 * A frame with the edges of those names moved to the right and down; all four move it as a whole.
 *
 * Its width stays `aspect` times its height, unless that is null.
 */
export function moved(edges, names, right, down, aspect = null) {
  const isWhole = names.length === EDGES.length;
  const ways = [right, down, right, down].map((way, i) => {
    const [low, high] = [edges[i % 2], edges[(i % 2) + 2]];
    if (isWhole) {
      return clamp(way, -low, 1 - high);
    }
    return i < 2 ? clamp(way, -low, high - LEAST - low) : clamp(way, low + LEAST - high, 1 - high);
  });
  const free = edges.map((edge, i) => (names.includes(EDGES[i]) ? clamp(edge + ways[i], 0, 1) : edge));
  return aspect === null || isWhole ? free : held(edges, free, names, aspect);
}

/** A frame with that aspect, as wide or as high as the one that was dragged, whichever of these has changed more. */
function held(before, [left, top, right, bottom], names, aspect) {
  const [wide, high] = [right - left, aspect * (bottom - top)];
  const followsWidth = Math.abs(wide - (before[2] - before[0])) >= Math.abs(high - aspect * (before[3] - before[1]));
  const room = EDGES.map((_, i) => (names.includes(EDGES[i]) ? (i < 2 ? before[i + 2] : 1 - before[i - 2]) : 1));
  const most = Math.min(room[0], room[2], aspect * Math.min(room[1], room[3]));
  const width = clamp(followsWidth ? wide : high, Math.min(LEAST * Math.max(1, aspect), most), most);
  const [start, end] = placed(before, 0, names, width);
  const [first, last] = placed(before, 1, names, width / aspect);
  return [start, first, end, last].map((edge) => clamp(edge, 0, 1)); // rounding may lead beyond the border
}

/** Both edges along an axis, of that length: the one opposite to a dragged one stays, or the middle if none is dragged. */
function placed(edges, axis, names, length) {
  const [low, high] = [edges[axis], edges[axis + 2]];
  if (names.includes(EDGES[axis])) {
    return [high - length, high];
  }
  const start = names.includes(EDGES[axis + 2]) ? low : clamp((low + high - length) / 2, 0, 1 - length);
  return [start, start + length];
}

/** A frame without an edge that rounding has put beyond another. */
export function atLeast([left, top, right, bottom]) {
  const [start, end] = apart(left, right);
  const [first, last] = apart(top, bottom);
  return [start, first, end, last];
}

/** Both edges along an axis, with the first moved back where the border leaves no room for the second. */
function apart(low, high) {
  const end = Math.min(Math.max(high, low + LEAST / 2), 1);
  return [Math.min(low, end - LEAST / 2), end];
}
