/** Curves of measured points: every one with times of its own, drawn as they are, never resampled. */

const GAP_S = 1;

/** Return curves as CSV, a row for each point: they need not have been measured at the same instants. */
export function curvesAsCsv(curves) {
  const rows = ["time_s,channel,value,unit"];
  for (const { xs, ys, length, label, unit } of curves) {
    for (let at = 0; at < length; at += 1) rows.push(`${xs[at].toFixed(6)},"${label.replaceAll('"', '""')}",${ys[at]},${unit}`);
  }
  return `${rows.join("\n")}\n`;
}

/** A quantity against time. */
export class Curve {
  /** Seconds and values; `length` of them count. */
  xs;
  ys;
  length;
  hidden = false;

  constructor({ label, unit, pane = unit, colour, dash = [], step = false, gapS = GAP_S, xs, ys, length = xs.length }) {
    Object.assign(this, { label, unit, pane, colour, dash, step, gapS, xs, ys, length });
  }

  /** Index of the last point at or before a time; -1 when there is none. */
  indexAt(x) {
    let [low, high] = [0, this.length];
    while (low < high) {
      const middle = (low + high) >> 1;
      if (this.xs[middle] <= x) low = middle + 1;
      else high = middle;
    }
    return low - 1;
  }

  /** The value at a time: that of the nearest point, null where there is none near. */
  valueAt(x) {
    const before = this.indexAt(x);
    const nearest = [before, before + 1]
      .filter((index) => index >= 0 && index < this.length)
      .sort((one, other) => Math.abs(this.xs[one] - x) - Math.abs(this.xs[other] - x))[0];
    if (nearest === undefined || Math.abs(this.xs[nearest] - x) > this.gapS) return null;
    return Number.isFinite(this.ys[nearest]) ? this.ys[nearest] : null;
  }

  /** Lowest and highest value within a span; null when it has none there. */
  rangeWithin({ min, max }) {
    let [low, high] = [Infinity, -Infinity];
    for (let index = Math.max(0, this.indexAt(min)); index < this.length && this.xs[index] <= max; index += 1) {
      const value = this.ys[index];
      if (value < low) low = value;
      if (value > high) high = value;
    }
    return low <= high ? { low, high } : null;
  }

  /** Draw the part within a span; points of one pixel column become its extremes. */
  draw(context, span, toX, toY) {
    const [xs, ys] = [this.xs, this.ys];
    const first = Math.max(0, this.indexAt(span.min));
    let [column, low, high, last, lastX] = [NaN, 0, 0, 0, -Infinity];
    const pen = () => {
      if (low === high) return;
      context.lineTo(column, toY(low));
      context.lineTo(column, toY(high));
      context.lineTo(column, toY(last));
    };
    context.beginPath();
    for (let index = first; index < this.length; index += 1) {
      const [x, y] = [xs[index], ys[index]];
      if (!Number.isFinite(y)) {
        lastX = -Infinity;
        continue;
      }
      const pixel = Math.round(toX(x));
      if (x - lastX > this.gapS) {
        pen();
        context.moveTo(pixel, toY(y));
        [column, low, high] = [pixel, y, y];
      } else if (pixel === column) {
        low = Math.min(low, y);
        high = Math.max(high, y);
      } else {
        pen();
        if (this.step) context.lineTo(pixel, toY(last));
        context.lineTo(pixel, toY(y));
        [column, low, high] = [pixel, y, y];
      }
      [last, lastX] = [y, x];
      if (x > span.max) break;
    }
    pen();
    context.stroke();
  }
}

/** A curve that grows at its end and forgets at its beginning. */
export class GrowingCurve extends Curve {
  constructor(shown, capacity) {
    super({ ...shown, xs: new Float64Array(2 * capacity), ys: new Float64Array(2 * capacity), length: 0 });
    this.capacity = capacity;
  }

  /** Append a point; one that is not later than the last is left out. */
  push(x, y) {
    if (this.length && x <= this.xs[this.length - 1]) return;
    if (this.length === this.xs.length) {
      this.xs.copyWithin(0, this.capacity);
      this.ys.copyWithin(0, this.capacity);
      this.length = this.capacity;
    }
    this.xs[this.length] = x;
    this.ys[this.length] = y;
    this.length += 1;
  }
}
