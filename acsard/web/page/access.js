// Access to the page: exchanges an invitation for a cookie, explains why access is refused, and disables each
// control that the robot would refuse to this client.

const AGAIN = 1000; // ms before the next attempt, while the robot does not answer an invitation
const SHUT = [401, 403, 429]; // HTTP statuses for which a repeated request is pointless

/** Exchange the token of an invitation (behind the # of the URL) for a cookie. If the present cookie has more
 *  permissions, ask first. The token is removed from the URL once it was accepted or finally rejected. Returns
 *  the reason for a rejection, or "" if there is no rejection or no invitation. `waiting(why)` is called while
 *  the robot does not answer. */
export async function invited(waiting) {
  const token = new URLSearchParams(location.hash.slice(1)).get("token");
  if (!token) return "";
  for (let replace = false; ; ) {
    const { status, error } = await shown(token, replace);
    if (status === 409 && !replace && (replace = confirm(`${error}. Use the link anyway?`))) continue;
    if (status && status < 500 && status !== 429) history.replaceState(null, "", location.pathname);
    if (status === 409) return "";
    if (status === 401) return "this invitation is not valid: it has expired, was revoked, or is incomplete. Ask for a new one (acsard web invite)";
    if (status && status < 500) return error;
    waiting(`your invitation has no answer yet (${error}); this page sends it again`);
    await new Promise((done) => setTimeout(done, AGAIN));
  }
}

async function shown(token, replace) {
  const headers = { "Content-Type": "application/json" };
  // The redirect leads to this page, which need not be fetched again.
  const how = { method: "POST", headers, body: JSON.stringify({ token, replace }), redirect: "manual" };
  return asked("token", how, 5000, (answer) => (answer.type === "opaqueredirect" ? { status: 303, error: "" } : null));
}

/** Return why a WebSocket is refused, as {why, shut, barred}, because no browser reports this. `shut` means that a
 *  repeated attempt is pointless. `barred` means that the robot refuses everything from this browser, also STOP. */
export async function refusal() {
  const { status, error, full } = await asked("api/whoami", {}, 2000);
  return { why: error || full || "", shut: SHUT.includes(status), barred: BARRED.includes(status) };
}

/** Return the JSON answer with its status, or status 0 if there was no answer. */
async function asked(path, how, within, special = () => null) {
  try {
    const answer = await fetch(path, { ...how, signal: expiring(within) });
    const told = special(answer) ?? (await answer.json());
    return { error: answer.ok ? "" : `${answer.status}`, status: answer.status, ...told };
  } catch {
    return { status: 0, error: "no answer from the robot" };
  }
}

/** Return why this client may not do `what` ("drive", a service, ...), in words, or "" if it may. */
export function barred(hello, what) {
  return hello ? (hello.barred[what] ?? "") : "no connection yet";
}

/** Return the hint at the stick while it is not held: how to drive, or why this user cannot. */
export function hint(hello) {
  return barred(hello, "drive") ? "You may watch and stop, but not drive." : "Hold and push to drive; release to stop.";
}

/** Disable the controls that this client may not use and explain why, on the control and in its description.
 *  `needless` maps each control that would change nothing now to the reason. `hello` is undefined while no robot has
 *  answered. */
export function permit(hello, needless = {}) {
  document.getElementById("barred").textContent = barred(hello, "drive");
  for (const one of document.querySelectorAll("[data-does]")) {
    const why = barred(hello, one.dataset.does) || needless[one.dataset.does] || "";
    if ("disabled" in one) one.disabled = Boolean(why);
    else one.setAttribute("aria-disabled", String(Boolean(why)));
    one.title = why;
  }
}
