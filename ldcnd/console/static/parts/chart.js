/** A chart: one pane for each unit, errors apart from positions, one time axis for all. uPlot draws grids and axes, the curves draw themselves. */

import uPlot from "../vendor/uplot/uPlot.esm.js";

const AXIS_PX = 56;
const TIME_AXIS_PX = 28;
const LABEL_PX = 18;
const LEAST_PX = 100;
const DRAG_PX = 6;
const MARGIN = 0.08;
/** A range is kept while its curves fill more than this much of it: an axis that twitches cannot be read. */
const FILLED = 0.45;
const CURSORS = ["a", "b"];

/** Charts into `root`; give it `curves` and a `span`, then call `draw`. */
export class Chart {
  curves = [];
  span = { min: -10, max: 0 };
  /** Two instants to compare, or null. */
  cursors = { a: null, b: null };
  /** How often it was drawn: what the redraw rate is counted from. */
  drawn = 0;

  #panes = [];
  #root;
  #height;
  #resizing;
  #scheme;
  #recolour = () => this.show(this.curves);
  #dragged = false;

  /** Called with a span that was dragged over. */
  onZoom = () => {};
  /** Called with "a" or "b" and the instant that was clicked. */
  onPick = () => {};

  constructor(root, { height = 380 } = {}) {
    this.#root = root;
    this.#height = height;
    this.#resizing = new ResizeObserver(() => this.#resize());
    this.#resizing.observe(root);
    this.#scheme = matchMedia("(prefers-color-scheme: dark)");
    this.#scheme.addEventListener("change", this.#recolour);
  }

  /** Show these curves; builds the panes anew. */
  show(curves) {
    this.curves = curves;
    const units = [...new Set(curves.map((curve) => curve.pane))];
    this.#panes.forEach((pane) => pane.plot.destroy());
    this.#panes = (units.length ? units : [""]).map((unit, index, all) =>
      this.#pane(unit, index === all.length - 1, all.length),
    );
    this.draw();
  }

  /** Draw everything as it is now. */
  draw() {
    for (const pane of this.#panes) {
      pane.range = fitted(pane.range, this.#shown(pane.unit), this.span);
      pane.plot.batch(() => {
        pane.plot.setScale("x", this.span);
        pane.plot.setScale("y", pane.range);
      });
    }
    this.drawn += 1;
  }

  /** The earliest and latest instant of all curves. */
  extent() {
    const filled = this.curves.filter((curve) => curve.length && !curve.hidden);
    if (!filled.length) return { min: 0, max: 1 };
    const min = Math.min(...filled.map((curve) => curve.xs[0]));
    const max = Math.max(...filled.map((curve) => curve.xs[curve.length - 1]));
    return { min, max: max > min ? max : min + 1 };
  }

  /** Everything in one picture, as a PNG. */
  async png() {
    const canvases = this.#panes.map((pane) => pane.plot.ctx.canvas);
    const picture = document.createElement("canvas");
    picture.width = Math.max(...canvases.map((each) => each.width));
    picture.height = canvases.reduce((sum, each) => sum + each.height, 0);
    const context = picture.getContext("2d");
    context.fillStyle = colour("--panel");
    context.fillRect(0, 0, picture.width, picture.height);
    let top = 0;
    for (const canvas of canvases) {
      context.drawImage(canvas, 0, top);
      top += canvas.height;
    }
    return new Promise((resolve) => picture.toBlob(resolve, "image/png"));
  }

  destroy() {
    this.#resizing.disconnect();
    this.#scheme.removeEventListener("change", this.#recolour);
    this.#panes.forEach((pane) => pane.plot.destroy());
    this.#panes = [];
  }

  #shown(unit) {
    return this.curves.filter((curve) => curve.pane === unit && !curve.hidden);
  }

  #pane(unit, isLast, count) {
    const pane = { unit, range: null, plot: null };
    const [line, text] = [colour("--grid"), colour("--quiet")];
    const font = `12px ${getComputedStyle(document.body).fontFamily}`;
    const axis = { stroke: text, font, grid: { stroke: line, width: 1 }, ticks: { show: false } };
    pane.plot = new uPlot(
      {
        width: this.#root.clientWidth || 600,
        height: this.#paneHeight(isLast, count),
        legend: { show: false },
        padding: [10, 14, isLast ? 0 : 6, 0],
        cursor: { drag: { x: true, y: false, setScale: false }, points: { show: false }, y: false },
        scales: { x: { time: false, auto: false }, y: { auto: false } },
        axes: [
          {
            ...axis,
            size: isLast ? TIME_AXIS_PX : 0,
            values: isLast ? undefined : () => [],
            label: isLast ? "seconds" : undefined,
            labelSize: LABEL_PX,
            labelFont: font,
            labelGap: 0,
          },
          {
            ...axis,
            size: AXIS_PX,
            label: unit || "0 or 1",
            labelSize: LABEL_PX,
            labelFont: font,
            labelGap: 0,
            values: (plot, ticks) => ticks.map((each) => `${Number(each.toPrecision(7))}`.replace("-", "−")),
          },
        ],
        series: [{}, { show: false }],
        hooks: {
          draw: [(plot) => this.#drawPane(plot, pane)],
          setSelect: [(plot) => this.#zoomed(plot)],
          ready: [(plot) => plot.over.addEventListener("click", (event) => this.#picked(plot, event))],
        },
      },
      [
        [0, 1],
        [null, null],
      ],
      this.#root,
    );
    return pane;
  }

  #drawPane(plot, pane) {
    const { ctx, bbox } = plot;
    const toX = (x) => plot.valToPos(x, "x", true);
    const toY = (y) => plot.valToPos(y, "y", true);
    ctx.save();
    ctx.beginPath();
    ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
    ctx.clip();
    ctx.lineJoin = "round";
    for (const curve of this.#shown(pane.unit)) {
      ctx.lineWidth = 1.75 * devicePixelRatio;
      ctx.strokeStyle = colour(curve.colour);
      ctx.setLineDash(curve.dash.map((each) => each * devicePixelRatio));
      curve.draw(ctx, this.span, toX, toY);
    }
    this.#drawCursors(ctx, bbox, toX);
    ctx.restore();
  }

  #drawCursors(ctx, bbox, toX) {
    ctx.lineWidth = devicePixelRatio;
    ctx.font = `bold ${12 * devicePixelRatio}px ${getComputedStyle(document.body).fontFamily}`;
    for (const name of CURSORS) {
      if (this.cursors[name] === null) continue;
      const x = Math.round(toX(this.cursors[name]));
      ctx.strokeStyle = ctx.fillStyle = colour("--text");
      ctx.setLineDash(name === "a" ? [] : [6 * devicePixelRatio, 4 * devicePixelRatio]);
      ctx.beginPath();
      ctx.moveTo(x, bbox.top);
      ctx.lineTo(x, bbox.top + bbox.height);
      ctx.stroke();
      ctx.fillText(name.toUpperCase(), x + 4 * devicePixelRatio, bbox.top + 13 * devicePixelRatio);
    }
  }

  #zoomed(plot) {
    const { left, width } = plot.select;
    if (width < DRAG_PX) return;
    const span = { min: plot.posToVal(left, "x"), max: plot.posToVal(left + width, "x") };
    plot.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
    this.#dragged = true;
    this.onZoom(span);
  }

  #picked(plot, event) {
    if (this.#dragged) {
      this.#dragged = false;
      return;
    }
    this.onPick(event.shiftKey ? "b" : "a", plot.posToVal(event.offsetX, "x"));
  }

  #paneHeight(isLast, count) {
    const below = TIME_AXIS_PX + LABEL_PX;
    return Math.max(LEAST_PX, Math.round((this.#height - below) / count)) + (isLast ? below : 0);
  }

  #resize() {
    const width = this.#root.clientWidth;
    if (!width) return;
    this.#panes.forEach((pane, index) => {
      if (pane.plot.width === width) return;
      const isLast = index === this.#panes.length - 1;
      pane.plot.setSize({ width, height: this.#paneHeight(isLast, this.#panes.length) });
    });
  }
}

/** Return the range to show: the present one while it fits, otherwise one with a margin. */
function fitted(present, curves, span) {
  const ranges = curves.map((curve) => curve.rangeWithin(span)).filter(Boolean);
  if (!ranges.length) return present ?? { min: -1, max: 1 };
  const low = Math.min(...ranges.map((range) => range.low));
  const high = Math.max(...ranges.map((range) => range.high));
  const needed = high - low;
  if (present && low >= present.min && high <= present.max && needed > FILLED * (present.max - present.min))
    return present;
  const margin = needed > 0 ? MARGIN * needed : Math.max(Math.abs(high) * 0.05, 0.01);
  if (present && needed === 0 && low >= present.min && high <= present.max && present.max - present.min <= 4 * margin)
    return present;
  return { min: low - margin, max: high + margin };
}

const colours = new Map();

/** The value of a colour of the style sheet, as the present scheme has it. */
function colour(name) {
  const scheme = matchMedia("(prefers-color-scheme: dark)").matches;
  const key = `${name} ${scheme}`;
  if (!colours.has(key)) colours.set(key, getComputedStyle(document.documentElement).getPropertyValue(name).trim());
  return colours.get(key);
}
