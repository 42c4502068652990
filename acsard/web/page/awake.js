// Keeps the screen on while the stick is held. When the screen locks, the browser hides the page, which releases the
// stick.

let held = false;
let lock = null;
let turn = Promise.resolve();

/** Register that the stick is held (`on`) or released. */
export function awake(on) {
  held = on;
  take();
}

/** Request or release the wake lock. The calls run one after the other, because a lock that is still being
 *  requested cannot be released. */
function take() {
  turn = turn.then(async () => {
    try {
      if (held && !document.hidden && (lock?.released ?? true)) lock = await navigator.wakeLock?.request("screen");
      else if (!held) await lock?.release();
    } catch {
      // Without HTTPS or with a low battery the browser refuses, and the screen locks as usual.
    }
  });
}

// The browser releases the lock when the page is hidden, so request it again.
document.addEventListener("visibilitychange", take);
