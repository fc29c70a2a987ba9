/** What the pages have to know of the public models, beyond what the daemon tells. A test compares it with them. */

/** Fields of set_gains. */
export const GAINS = {
  kp: { title: "position gain", min: 0, max: 32767, unit: "" },
  kd: { title: "velocity gain", min: 0, max: 32767, unit: "" },
  ki: { title: "integral gain", min: 0, max: 32767, unit: "" },
  il: { title: "integration limit", min: 0, max: 32767, unit: "" },
  ol: { title: "output limit", min: 0, max: 255, unit: "of 255" },
  cl: { title: "current limit, 0 is off", min: 0, max: 255, unit: "" },
  el: { title: "position error limit", min: 0, max: 32767, unit: "count" },
  deadband: { title: "amplifier deadband compensation", min: 0, max: 255, unit: "" },
  sr: { title: "servo rate divisor, standing axis only", min: 1, max: 255, unit: "" },
};

export const HOME_METHODS = ["index", "forward_limit", "reverse_limit", "position_error", "current"];
export const HOME_STOPS = ["smooth", "abrupt", "off"];

export const TRIGGER_KINDS = ["rising", "falling", "either", "change", "above", "below"];
/** Phases in which a trace is still on its way. */
export const TRACE_UNDER_WAY = ["filling", "waiting", "recording", "uploading"];
export const MOST_CHANNELS = 8;
export const MOST_SAMPLES = 10000;

export const COMMAND_STATUSES = ["accepted", "executing", "done", "aborted", "refused", "failed", "unknown"];
