// What the page holds.

export const data = JSON.parse(document.getElementById("data").textContent);

/** Data that were packed (deflate, base64), as bytes. */
export async function unpack(id) {
  const packed = Uint8Array.from(atob(document.getElementById(id).textContent), (c) => c.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Response(stream).arrayBuffer();
}

export async function unpackJSON(id) {
  return JSON.parse(new TextDecoder().decode(await unpack(id)));
}
