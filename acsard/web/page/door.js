// How this page comes in: the invitation that becomes a cookie, and why it is not let in.

const AGAIN = 1000; // ms until an invitation that nobody has answered is shown again
const SHUT = [401, 403, 429]; // who is not let in by these is not let in by asking again

/** Who comes by an invitation has its token behind the #: it becomes a cookie, and is wiped once that
 *  is so, or never will be. Returns why it did not, "" where there was none; `waiting(why)` is told
 *  while the robot does not answer. */
export async function invited(waiting) {
  const token = new URLSearchParams(location.hash.slice(1)).get("token");
  if (!token) return "";
  for (;;) {
    const { status, error } = await shown(token);
    if (status && status < 500 && status !== 429) history.replaceState(null, "", location.pathname);
    if (status === 401) return "this invitation is not valid: it has ended, was revoked, or is not whole. Ask for a new one (acsard web --invite)";
    if (status && status < 500) return error;
    waiting(`your invitation has no answer yet (${error}); it is shown again until it has`);
    await new Promise((done) => setTimeout(done, AGAIN));
  }
}

async function shown(token) {
  const headers = { "Content-Type": "application/json" };
  // Where it leads to is this page: not to be fetched once more.
  const how = { method: "POST", headers, body: JSON.stringify({ token }), redirect: "manual" };
  return asked("token", how, 5000, (answer) => (answer.type === "opaqueredirect" ? { status: 303, error: "" } : null));
}

/** Why a WebSocket is refused, which no browser tells its page: {why, shut}, `shut` where asking again
 *  changes nothing. */
export async function refusal() {
  const { status, error, full } = await asked("api/whoami", {}, 2000);
  return { why: error || full || "", shut: SHUT.includes(status) };
}

/** What was answered, with its status: 0 where nothing was. */
async function asked(path, how, within, special = () => null) {
  try {
    const answer = await fetch(path, { ...how, signal: AbortSignal.timeout(within) });
    const told = special(answer) ?? (await answer.json());
    return { error: answer.ok ? "" : `${answer.status}`, status: answer.status, ...told };
  } catch {
    return { status: 0, error: "no answer from the robot" };
  }
}
