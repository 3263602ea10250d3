const finite = (x) =>
  Array.isArray(x) ? [...x].every(finite) : typeof x === "boolean" || Number.isFinite(x);
const nan = (x) => (Array.isArray(x) ? x.some(nan) : Number.isNaN(Number(x)));
const rint = (x) => (Math.abs(x % 1) === 0.5 ? 2 * Math.round(x / 2) : Math.round(x));
const unpacked = (text, Kind, rows) => {
  const all = new Kind(Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer);
  const columns = all.length / rows;
  return Array.from({ length: rows }, (_, i) => all.subarray(i * columns, (i + 1) * columns));
};
