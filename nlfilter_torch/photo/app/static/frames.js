/** The arithmetic of a frame: `[left, top, right, bottom]`, shares of the width and height of a picture. */

export const EDGES = ["left", "top", "right", "bottom"];
const LEAST = 0.01; // the least side of a frame, as a share of the picture

const clamp = (value, low, high) => Math.min(Math.max(value, low), high);

/** A frame with the edges of those names moved to the right and down; all four move it as a whole. */
export function moved(edges, names, right, down) {
  const isWhole = names.length === EDGES.length;
  const ways = [right, down, right, down].map((way, i) => {
    const [low, high] = [edges[i % 2], edges[(i % 2) + 2]];
    if (isWhole) {
      return clamp(way, -low, 1 - high);
    }
    return i < 2 ? clamp(way, -low, high - LEAST - low) : clamp(way, low + LEAST - high, 1 - high);
  });
  return edges.map((edge, i) => (names.includes(EDGES[i]) ? clamp(edge + ways[i], 0, 1) : edge));
}

/** A frame without an edge that rounding has put beyond another. */
export function atLeast([left, top, right, bottom]) {
  return [left, top, Math.max(right, left + LEAST / 2), Math.max(bottom, top + LEAST / 2)];
}
