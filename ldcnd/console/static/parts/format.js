/** Numbers and times as text: always the same number of digits, so that they stand still while they change. */

/** A number with a fixed count of decimals and a real minus; a dash when there is none. */
export function number(value, decimals = 3) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  const text = value.toFixed(decimals);
  return (Number(text) === 0 ? text.replace("-", "") : text).replace("-", "−");
}

/** So many decimals show single encoder counts. */
export function decimalsOf(info) {
  const counts = info?.counts_per_unit;
  return counts ? Math.min(6, Math.max(0, Math.ceil(Math.log10(counts)))) : 0;
}

/** Seconds in the unit that fits. */
export function duration(seconds) {
  if (seconds === null || seconds === undefined) return "–";
  if (seconds === 0) return "0 s";
  if (seconds < 0.001) return `${number(seconds * 1e6, 0)} µs`;
  if (seconds < 1) return `${number(seconds * 1e3, seconds < 0.01 ? 2 : 0)} ms`;
  return seconds < 100 ? `${number(seconds, 2)} s` : `${number(seconds / 60, 0)} min`;
}

/** An age, to a tenth of a second while it is short. */
export function age(seconds) {
  if (seconds === null) return "never";
  if (seconds < 10) return `${number(seconds, 1)} s`;
  return seconds < 120 ? `${number(seconds, 0)} s` : `${number(seconds / 60, 0)} min`;
}

/** A share as a percentage. */
export function percent(share) {
  return share === null || share === undefined ? "–" : `${number(share * 100, share < 0.1 ? 1 : 0)} %`;
}

/** An instant in ns since 1970 as local time of day, to the millisecond. */
export function clock(ns) {
  if (Number.isNaN(ns)) return "--:--:--.---";
  const at = new Date(ns / 1e6);
  const two = (value) => String(value).padStart(2, "0");
  const time = [at.getHours(), at.getMinutes(), at.getSeconds()].map(two).join(":");
  return `${time}.${String(at.getMilliseconds()).padStart(3, "0")}`;
}

/** The same with the date. */
export function dateAndClock(ns) {
  const at = new Date(ns / 1e6);
  const two = (value) => String(value).padStart(2, "0");
  return `${at.getFullYear()}-${two(at.getMonth() + 1)}-${two(at.getDate())} ${clock(ns)}`;
}

/** A name of the interface as words. */
export function words(name) {
  return String(name ?? "–").replaceAll("_", " ");
}

/** A message with the point that ends a sentence: those of the daemon have none. */
export function sentence(text) {
  return !text || /[.!?]$/.test(text) ? text : `${text}.`;
}
