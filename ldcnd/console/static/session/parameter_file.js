/** Dumps of parameters as TOML, the same files that `ldcnd params` writes and reads. */

const LINE = /^\s*"?(Pn[0-9A-Fa-f]{3})"?\s*=\s*(0x[0-9A-Fa-f]+|\d+)\s*(#.*)?$/;
const LARGEST = 0xffff;

/** Return a dump: what is stored, with a remark where another value is in use. */
export function asToml(axis, values) {
  const lines = values.map(
    ({ parameter, stored, active, name }) =>
      `${parameter} = ${stored}  # ${name}${stored === active ? "" : `, in use ${active}`}`,
  );
  return `axis = "${axis}"\n\n[parameters]\n${lines.join("\n")}\n`;
}

/** Return the values of a dump by parameter; raises an Error that names the line which is none. */
export function fromToml(text) {
  const values = new Map();
  let inside = false;
  text.split(/\r?\n/).forEach((line, index) => {
    if (/^\s*\[/.test(line)) inside = line.trim() === "[parameters]";
    else if (inside && line.trim() && !line.trim().startsWith("#")) {
      const [, parameter, number] = LINE.exec(line) ?? [];
      const value = Number(number);
      if (!parameter || value > LARGEST) throw new Error(`Line ${index + 1} is no parameter: ${line.trim()}`);
      values.set(parameter, value);
    }
  });
  if (!values.size) throw new Error("This file holds no [parameters].");
  return values;
}
