// Faults of a page of the site: weak contrasts, images without text, requests to other hosts, ...
const rgb = (text) => (text.match(/[\d.]+/g) || [0, 0, 0, 0]).map(Number);
const light = (c) => { const f = c.slice(0, 3).map((v) => v / 255).map((v) => v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
  return 0.2126 * f[0] + 0.7152 * f[1] + 0.0722 * f[2]; };
const over = (top, below) => { const a = top.length > 3 ? top[3] : 1; return [0, 1, 2].map((i) => a * top[i] + (1 - a) * below[i]); };
const ground = (e) => { const layers = []; for (; e; e = e.parentElement) { const c = rgb(getComputedStyle(e).backgroundColor); if ((c[3] ?? 1) > 0) layers.push(c); if ((c[3] ?? 1) === 1) break; }
  return layers.reduceRight((below, top) => over(top, below), [255, 255, 255]); };
const dark = light(ground(document.body)) < 0.2;
const weak = [];
const walker = document.createTreeWalker(document.querySelector('.md-main') || document.body, NodeFilter.SHOW_TEXT);
while (walker.nextNode()) {
  const e = walker.currentNode.parentElement, text = walker.currentNode.data.trim();
  if (!text || !e.checkVisibility({opacityProperty: true, visibilityProperty: true}) || e.closest('svg, script, style, .headerlink')) continue;
  const style = getComputedStyle(e), below = ground(e), a = light(over(rgb(style.color), below)), b = light(below);
  const ratio = (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
  const large = parseFloat(style.fontSize) >= 24 || (parseFloat(style.fontSize) >= 18.66 && style.fontWeight >= 700);
  if (ratio < (large ? 3 : 4.5)) weak.push(`${ratio.toFixed(2)} ${e.tagName}.${e.className}: ${text.slice(0, 30)}`);
}
return {
  weak: [...new Set(weak)].slice(0, 8),
  images: [...document.images].filter((i) => !i.alt.trim()).map((i) => i.src),
  broken: [...document.images].filter((i) => i.complete && !i.naturalWidth && i.loading !== 'lazy').map((i) => i.src),
  hosts: performance.getEntriesByType('resource').map((r) => r.name).filter((n) => !n.startsWith(location.origin) && !n.startsWith('data:') && !n.startsWith('blob:')),
  dark,
  scroll: document.scrollingElement.scrollWidth - innerWidth,
  tables: innerWidth < 1000 ? [] : [...document.querySelectorAll('table, .md-typeset__scrollwrap')].filter((t) => t.scrollWidth > t.clientWidth + 1).map((t) => `${t.scrollWidth - t.clientWidth} px: ${t.innerText.slice(0, 80)}`),
  unnamed: [...document.querySelectorAll('a[href], button')].filter((a) => !a.textContent.trim() && !a.title && !a.ariaLabel && !a.querySelector('img[alt]')).map((a) => a.outerHTML.slice(0, 80)),
};
