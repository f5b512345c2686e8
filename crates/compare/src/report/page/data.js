"use strict";
// The report page. Data come from the element #data; everything is drawn on canvas.
// Heights nm, lengths mm, times s.

const DATA = JSON.parse(document.getElementById("data").textContent);
const byId = (id) => document.getElementById(id);

// Numbers from text.

function bytesOf(base64) {
  const text = atob(base64);
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  return bytes;
}

/** value = offset + scale q; q = -32768 is NaN. */
function unpack(packed) {
  const q = new Int16Array(bytesOf(packed.i16).buffer);
  const values = new Float64Array(q.length);
  for (let i = 0; i < q.length; i++) values[i] = q[i] === -32768 ? NaN : packed.offset + packed.scale * q[i];
  return values;
}

const floats = (base64) => new Float32Array(bytesOf(base64).buffer);
const doubles = (base64) => new Float64Array(bytesOf(base64).buffer);

/** The function, computed once. */
function once(make) {
  let value;
  return () => (value === undefined ? (value = make()) : value);
}
