// Requests to the daemon, with token and lease; its errors are passed on verbatim.

const ROOT = "/api/v1";
const TOKEN_KEY = "hdbridge.token";
let leaseToken = null;

// The page's address may end in #token=...; the part after # never leaves the browser.
const given = /^#token=([A-Za-z0-9._~-]+)$/.exec(location.hash);
if (given) {
  sessionStorage.setItem(TOKEN_KEY, given[1]);
  history.replaceState(null, "", location.pathname);
}

export class Problem extends Error {
  constructor(status, body) {
    super(body.detail || body.title || `status ${status}`);
    this.status = status;
    this.hint = body.hint || null;
  }
}

export const token = () => sessionStorage.getItem(TOKEN_KEY);
export const keepToken = (text) => sessionStorage.setItem(TOKEN_KEY, text);
export const holdsLease = () => leaseToken !== null;

export async function ask(method, path, body) {
  const headers = { Accept: "application/json" };
  if (token()) headers.Authorization = `Bearer ${token()}`;
  if (leaseToken) headers["X-Lease"] = leaseToken;
  if (body !== undefined) headers["Content-Type"] = "application/json";
  const answer = await fetch(ROOT + path, {
    method,
    headers,
    body: body === undefined ? undefined : JSON.stringify(body),
    cache: "no-store",
    credentials: "omit",
  });
  const text = await answer.text();
  let parsed = {};
  try {
    parsed = text ? JSON.parse(text) : {};
  } catch {
    parsed = { detail: `the daemon's answer is not JSON (status ${answer.status})` };
  }
  if (!answer.ok) {
    if (answer.status === 423) leaseToken = null;
    throw new Problem(answer.status, parsed);
  }
  return parsed;
}

export async function takeLease(force) {
  const grant = await ask("POST", "/lease", { client: "live page", force });
  leaseToken = grant.token;
  return grant;
}

export const renewLease = () => ask("PUT", "/lease");

export async function releaseLease() {
  try {
    await ask("DELETE", "/lease");
  } finally {
    leaseToken = null;
  }
}

export const axisPath = (axis, what) => `/axes/${encodeURIComponent(axis)}/${what}`;

export function socket(path) {
  const scheme = location.protocol === "https:" ? "wss:" : "ws:";
  // A browser cannot set a header here, and an address ends up in logs: the token goes as a subprotocol.
  const offered = ["hdbridge.v1", ...(token() ? [`bearer.${token()}`] : [])];
  return new WebSocket(`${scheme}//${location.host}${ROOT}${path}`, offered);
}
