// A plot with two logarithmic axes, as SVG.

const kWidth = 600, kHeight = 440;
const kFrame = { left: 76, right: 588, top: 48, bottom: 392 };

/** At these digits of every decade of [lo, hi]. */
function decadeTicks(lo, hi, ticked) {
  const ticks = [];
  for (let e = Math.floor(Math.log10(lo)); e <= Math.log10(hi); ++e) ticks.push(...ticked.map(digit => Number(`${digit}e${e}`)));
  return ticks.filter(t => t >= lo && t <= hi);
}

/** In equal steps of a power of ten. */
function evenTicks(lo, hi) {
  const e = Math.floor(Math.log10((hi - lo) / 2));
  const ticks = [];
  for (let i = Math.ceil(lo / 10 ** e); i <= hi / 10 ** e; ++i) ticks.push(Number(`${i}e${e}`));
  return ticks;
}

/** An axis: from value to pixel, with the finest ticks that have room. */
function logAxis(values, margin, from, to) {
  const lo = Math.min(...values) / margin, hi = Math.max(...values) * margin;
  const pixel = v => from + (to - from) * Math.log(v / lo) / Math.log(hi / lo);
  const hasRoom = ticks => ticks.every((t, i) => i === 0 || Math.abs(pixel(t) - pixel(ticks[i - 1])) > 20);
  const ticks = [evenTicks(lo, hi), decadeTicks(lo, hi, [1, 2, 5]), decadeTicks(lo, hi, [1])].find(t => t.length > 1 && hasRoom(t));
  return { lo, hi, pixel, ticks: ticks || [lo, hi] };
}

const kShapes = {
  cross: 'M-4 -4L4 4M-4 4L4 -4', plus: 'M-4 0H4M0 -4V4', square: 'M-3 -3H3V3H-3Z', box: 'M-3 -3H3V3H-3Z',
  circle: 'M-3 0A3 3 0 1 0 3 0A3 3 0 1 0 -3 0Z', triangle: 'M0 -4L3.6 2.6H-3.6Z', diamond: 'M0 -4.4L4.4 0L0 4.4L-4.4 0Z'
};

function marker(x, y, series, title) {
  const open = ['cross', 'plus', 'box'].includes(series.shape);
  return `<path class="mark" d="${kShapes[series.shape]}" transform="translate(${x.toFixed(1)} ${y.toFixed(1)})" ` +
    `stroke="${series.color}" fill="${open ? 'none' : series.color}">${title ? `<title>${escaped(title)}</title>` : ''}` +
    '</path>';
}

/**
 * series: [{title, color, shape, points: [{x, y, title}]}], some of them with points; front: points by x, a line in
 * steps; vertical: {x, title} or null; trade: y = sqrt(trade 10^k / x) are pale lines, or null.
 */
function plotOf({ xTitle, yTitle, series, front, vertical, trade }) {
  const points = series.flatMap(s => s.points);
  const xs = points.map(p => p.x).concat(vertical ? [vertical.x] : []);
  const x = logAxis(xs, 1.2, kFrame.left, kFrame.right);
  const y = logAxis(points.map(p => p.y), 1.5, kFrame.bottom, kFrame.top);
  const { left, right, top, bottom } = kFrame;
  const clip = `<rect x="${left}" y="${top}" width="${right - left}" height="${bottom - top}"`;
  const id = `clip${plotOf.count = (plotOf.count || 0) + 1}`;
  let svg = `<svg viewBox="0 0 ${kWidth} ${kHeight}" role="img"><clipPath id="${id}">${clip}/></clipPath>`;
  for (const t of x.ticks) {
    const at = x.pixel(t).toFixed(1);
    svg += `<path class="grid" d="M${at} ${top}V${bottom}"/><text x="${at}" y="${bottom + 17}" text-anchor="middle">${t}</text>`;
  }
  for (const t of y.ticks) {
    const at = y.pixel(t).toFixed(1);
    svg += `<path class="grid" d="M${left} ${at}H${right}"/><text x="${left - 6}" y="${+at + 4}" text-anchor="end">${t}</text>`;
  }
  svg += `<g clip-path="url(#${id})">`;
  if (trade) {
    for (let k = -12; k <= 12; ++k) {
      const at = v => y.pixel(Math.sqrt(trade * 10 ** k / v)).toFixed(1);
      svg += `<path class="trade" d="M${left} ${at(x.lo)}L${right} ${at(x.hi)}"/>`;
    }
  }
  if (vertical) {
    const at = x.pixel(vertical.x);
    svg += `<path class="exact" d="M${at} ${top}V${bottom}"/><text transform="translate(${at - 5} ${bottom - 10}) ` +
      `rotate(-90)">${escaped(vertical.title)}</text>`;
  }
  if (front.length > 0) {
    svg += `<path class="front" d="M${x.pixel(front[0].x)} ${y.pixel(front[0].y)}` +
      front.slice(1).map(p => `H${x.pixel(p.x)}V${y.pixel(p.y)}`).join('') + '"/>';
  }
  for (const s of series) {
    svg += s.points.map(p => marker(x.pixel(p.x), y.pixel(p.y), s, p.title)).join('');
  }
  svg += `</g>${clip} class="frame"/>`;
  const legend = series.map(s => ({ title: s.title, draw: at => marker(at, 0, s) }));
  if (front.length > 0) legend.push({ title: 'best unbiased', draw: at => `<path class="front" d="M${at - 6} 0h12"/>` });
  legend.forEach((entry, i) => {
    svg += `<g transform="translate(${left + 12 + i % 4 * 136} ${14 + Math.floor(i / 4) * 18})">${entry.draw(0)}` +
      `<text x="10" y="4">${entry.title}</text></g>`;
  });
  return `${svg}<text x="${(left + right) / 2}" y="${kHeight - 8}" text-anchor="middle">${xTitle}</text>` +
    `<text transform="translate(13 ${(top + bottom) / 2}) rotate(-90)" text-anchor="middle">${yTitle}</text></svg>`;
}
