// Keeps the screen on while this page moves something. When the screen locks, the browser hides the page, which
// releases the stick and ends a drive of a calibration.

const movers = new Set();
let lock = null;
let turn = Promise.resolve();

/** Register that `mover` starts (`on`) or stops moving something. */
export function awake(mover, on) {
  if (on === movers.has(mover)) return;
  if (on) movers.add(mover);
  else movers.delete(mover);
  take();
}

/** Request or release the wake lock. The calls run one after the other, because a lock that is still being
 *  requested cannot be released. */
function take() {
  turn = turn.then(async () => {
    const wanted = movers.size > 0 && !document.hidden;
    try {
      if (wanted && (lock?.released ?? true)) lock = await navigator.wakeLock?.request("screen");
      else if (!movers.size) await lock?.release();
    } catch {
      // Without HTTPS or with a low battery the browser refuses, and the screen locks as usual.
    }
  });
}

// The browser releases the lock when the page is hidden, so request it again.
document.addEventListener("visibilitychange", take);
