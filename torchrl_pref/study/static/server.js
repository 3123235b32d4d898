// Requests to the server of the study.

const TOKEN = new URLSearchParams(location.hash.slice(1)).get("token");

/** How long a reply is waited for. */
const PATIENCE = 20000;

function headers() {
  return TOKEN === null ? {} : { "X-Study-Token": TOKEN };
}

/** Status and content of a reply; it throws where there is none. */
export async function get(path) {
  const reply = await fetch(path, { headers: headers(), signal: AbortSignal.timeout(PATIENCE) });
  return { status: reply.status, content: await reply.json() };
}

/** The same of something that is to be done. */
export async function post(path, body) {
  const reply = await fetch(path, {
    method: "POST",
    headers: { "Content-Type": "application/json", ...headers() },
    body: JSON.stringify(body),
    signal: AbortSignal.timeout(PATIENCE),
  });
  return { status: reply.status, content: await reply.json() };
}

const images = new Map();
const MOST_IMAGES = 40;

/** The moments of an image file: images that a canvas can draw, with the share of time of each. */
export function moments(url) {
  if (!images.has(url)) {
    if (images.size >= MOST_IMAGES) images.delete(images.keys().next().value);
    images.set(url, load(url));
    images.get(url).catch(() => images.delete(url));
  }
  return images.get(url);
}

async function load(url) {
  const reply = await fetch(url, { headers: headers() });
  if (!reply.ok) throw new Error((await reply.json()).error);
  const file = await reply.blob();
  if (file.type === "image/gif" && "ImageDecoder" in window) return await decode(file);
  return { images: [await createImageBitmap(file)], whole: file.type !== "image/gif" };
}

async function decode(file) {
  const decoder = new ImageDecoder({ data: await file.arrayBuffer(), type: file.type });
  await decoder.tracks.ready;
  const found = [];
  for (let number = 0; number < decoder.tracks.selectedTrack.frameCount; number++) {
    const { image } = await decoder.decode({ frameIndex: number });
    found.push(await createImageBitmap(image));
    image.close();
  }
  decoder.close();
  return { images: found, whole: true };
}
