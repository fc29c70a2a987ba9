/** What a test move shows of a position loop, from a trace of it. Pure. */

const NEAR = 1e-9;
/** The last share of a trace, in which the axis should stand. */
const TAIL = 0.1;

/** Judge a move.
 *
 * Args: `seconds`, `position`, `error` (commanded minus actual, may be NaN) of the trace; `start` and `target` of the
 * move; `band`, half the width of what counts as settled, all in axis units; `profileS`, how long the profile takes.
 *
 * Returns times in seconds from the first sample in which the command moves, lengths in axis units: `overshoot` beyond
 * the target, `overshootShare` of the distance, `settlingS` from the profile's end until it stays within the band (null
 * when it never does), `riseS` from 10 % to 90 %, `peakError`, `rmsError`, `finalError` (target minus mean of the end).
 */
export function judge({ seconds, position, error, start, target, band, profileS }) {
  const distance = target - start;
  const way = Math.sign(distance);
  const begin = beginning(position, error, start, band);
  const beganAtS = seconds[begin];
  const moved = (share) => firstIndex(position, begin, (value) => way * (value - start) >= share * Math.abs(distance));
  const [low, high] = [moved(0.1), moved(0.9)];

  let beyond = 0;
  let outside = begin - 1;
  let [peak, squares, counted] = [0, 0, 0];
  for (let index = begin; index < position.length; index += 1) {
    beyond = Math.max(beyond, way * (position[index] - target));
    if (Math.abs(position[index] - target) > band) outside = index;
    if (Number.isFinite(error[index])) {
      peak = Math.max(peak, Math.abs(error[index]));
      squares += error[index] ** 2;
      counted += 1;
    }
  }
  const settled = outside + 1 < position.length;
  const tail = position.slice(Math.floor(position.length * (1 - TAIL)));
  return {
    beganAtS,
    overshoot: beyond,
    overshootShare: beyond / Math.abs(distance),
    settlingS: settled ? Math.max(0, seconds[outside + 1] - beganAtS - profileS) : null,
    riseS: low === null || high === null ? null : seconds[high] - seconds[low],
    peakError: counted ? peak : null,
    rmsError: counted ? Math.sqrt(squares / counted) : null,
    finalError: target - tail.reduce((sum, value) => sum + value, 0) / tail.length,
  };
}

/** The first sample in which the command has left the start; where the drive tells no error, the axis itself. */
function beginning(position, error, start, band) {
  const commanded = (index) => position[index] + (Number.isFinite(error[index]) ? error[index] : 0);
  const index = firstIndex(position, 0, (_, at) => Math.abs(commanded(at) - start) > Math.max(band / 10, NEAR));
  return index === null ? 0 : Math.max(0, index - 1);
}

function firstIndex(values, from, holds) {
  for (let index = from; index < values.length; index += 1) if (holds(values[index], index)) return index;
  return null;
}
