// The screen stays on while this page moves something: one that locks lets go of the stick and ends a leg.

const movers = new Set();
let lock = null;
let turn = Promise.resolve();

/** `mover` begins or ends to move something. */
export function awake(mover, on) {
  if (on === movers.has(mover)) return;
  if (on) movers.add(mover);
  else movers.delete(mover);
  take();
}

/** One after the other: a lock that is still asked for cannot be given back yet. */
function take() {
  turn = turn.then(async () => {
    const wanted = movers.size > 0 && !document.hidden;
    try {
      if (wanted && (lock?.released ?? true)) lock = await navigator.wakeLock?.request("screen");
      else if (!movers.size) await lock?.release();
    } catch {
      // No HTTPS, or a battery that is low: the screen locks as it always does.
    }
  });
}

// The browser gives it back when the page is hidden.
document.addEventListener("visibilitychange", take);
