/** Numbers that people type. The same rules as `ldcnd/contract/number_text.py`; one table of cases tests both. */

const NUMBER = /^([+\-−]?)(\d*)(?:([.,])(\d*))?(?:[eE]([+\-−]?\d+))?\s*([\s\S]*)$/;
const NOT_FINITE = /^[+\-−]?\s*(?:inf|nan|∞)/i;
/** What follows a number that has separators of thousands, as somewhere in the world, or is one of several. */
const SEPARATED = /^[.,'’_\s]*\d/;
/** A unit that may have a digit, such as mm/s2. */
const UNIT = /^\p{L}+(?:\/[a-z]+[2²]?)+$/u;
const LONGEST_QUOTE = 40;

/** Why a text is not taken as a number; it takes the place of the number, and nothing that holds it can be sent. */
export class Unread {
  constructor(message, text = "") {
    this.message = message;
    this.text = text;
  }

  /** Called for what is about to be sent. */
  toJSON() {
    throw new Error(`Nothing was sent: ${this.message}.`);
  }

  valueOf() {
    return Number.NaN;
  }
}

/** Return the number that a text stands for, null for an empty text, or why it is none.

 * `unit` may stand behind the number; `whole`, `min` and `max` are what the number must be besides. With `units`, one of
 * them may stand behind the number, which is converted; without one it is in the first.
 */
export function readNumber(text, { unit = "", units = [{ unit }], whole = false, min = -Infinity, max = Infinity } = {}) {
  const written = text.trim();
  if (!written) return null;
  const value = numberOf(written, units);
  if (value instanceof Unread) return new Unread(value.message, text);
  if (whole && !Number.isSafeInteger(value)) return new Unread(`${quoted(written)} is not a whole number`, text);
  if (value < min || value > max) return new Unread(`${value} is not ${range(min, max)}`, text);
  return value;
}

/** Return a range in words. */
export function range(min, max) {
  if (max === Infinity) return `${min} or more`;
  return min === -Infinity ? `${max} or less` : `${min} to ${max}`;
}

const PER = { position: "", velocity: "/s", acceleration: "/s2" };

/** Return the units that are taken for a quantity of an axis, first the one that is shown, and how they are converted. */
export function unitsOf(info, dimension) {
  const sent = `${info.unit}${PER[dimension]}`;
  const table = Object.entries(info.units?.[dimension] ?? { [sent]: "1" });
  const units = table.map(([unit, ratio]) => {
    const [over, under = 1] = ratio.split("/").map(Number);
    return { unit, sent, from: (typed) => (typed * over) / under, to: (value) => (value * under) / over };
  });
  const g = dimension === "velocity" && info.g_velocity;
  if (g) units.push({ unit: "g", sent, from: (typed) => Math.sign(typed) * g * Math.sqrt(Math.abs(typed)), to: (value) => (value / g) ** 2 });
  return units;
}

/** Return a quantity of an axis as it is shown, its unit, what acts in g where the axis has a radius, and both as they are said. */
export function shownQuantity(value, info, dimension) {
  const [{ unit, to }, ...others] = unitsOf(info, dimension);
  const g = others.find((each) => each.unit === "g" && dimension === "velocity");
  const known = value !== null && value !== undefined;
  const acts = g && known ? `(${Number(g.to(value).toPrecision(3))} g)` : "";
  const shown = unit.replace("/s2", "/s²");
  return { value: known ? to(value) : null, unit: shown, acts, said: acts ? `${shown} ${acts}` : shown };
}

function numberOf(written, units) {
  const quote = quoted(written);
  if (NOT_FINITE.test(written)) return new Unread(`${quote} is not a finite number`);
  if (/^[+\-−]?0[xX]/.test(written)) return new Unread(`${quote} is not a decimal number`);
  const [, signed, whole, mark, part = "", raised = "0", rest] = NUMBER.exec(written);
  const [sign, power] = [signed.replace("−", "-").replace("+", ""), raised.replace("−", "-")];
  const digits = whole + part;
  if (/(?![0-9])\p{Nd}/u.test(written)) return new Unread(`${quote} has other digits than 0 to 9`);
  if (!digits) return new Unread(`${quote} is not a number`);
  const typed = rest === "" ? units[0] : units.find(({ unit }) => sameUnit(rest, unit));
  const isOther = !typed;
  if (isOther) {
    if (SEPARATED.test(rest))
      return new Unread(`${quote} is more than one number, or has thousands separators: type one number without them`);
    if ((/\d/.test(rest) && !UNIT.test(rest)) || /^[.,+\-−]/.test(rest)) return new Unread(`${quote} is not one number`);
  }
  if (mark === "," && /^[1-9]\d{0,2}$/.test(whole) && part.length === 3)
    return new Unread(`${quote} can mean ${sign}${whole}.${part} or ${sign}${whole}${part}: type one of them`);
  const names = units.map(({ unit }) => unit);
  const last = names.pop();
  if (isOther && names.length) return new Unread(`${quoted(rest)} is not a unit here: type the value in ${names.join(", ")} or ${last}`);
  if (isOther && last)
    return new Unread(`${quoted(rest)} is not the unit here, which is ${last}: type the value in ${last}`);
  if (isOther) {
    const plain = `${sign}${whole || "0"}${part && `.${part}`}${power === "0" ? "" : `e${power}`}`;
    return new Unread(`${quoted(rest)} is not taken behind the number: type ${plain}, in the unit that is named here`);
  }
  const value = Number(`${sign}${whole || "0"}.${part || "0"}e${power}`);
  if (!Number.isFinite(value)) return new Unread(`${quote} is too large`);
  if (!value && /[1-9]/.test(digits)) return new Unread(`${quote} is too close to 0`);
  const converted = typed.from?.(value) ?? value;
  if (!Number.isFinite(converted)) return new Unread(`${quote} is too large`);
  return converted || 0; // no minus zero
}

/** Units are compared as they look: ² is 2, micro is also written u, degrees with their sign. */
function sameUnit(written, unit) {
  return unit !== "" && plain(written) === plain(unit);
}

function plain(unit) {
  const bare = unit.normalize("NFKC").replaceAll("μ", "u").replaceAll("°", "deg").replaceAll(" ", "").replace(/rpm/i, "rpm");
  return /^[x×]g$/.test(bare) ? "g" : bare; // as the force in a centrifuge is written
}

function quoted(text) {
  return `“${text.length > LONGEST_QUOTE ? `${text.slice(0, LONGEST_QUOTE)}…` : text}”`;
}
