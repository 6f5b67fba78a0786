// The page of `vdbtrack measure`, from the report's JSON (libtrack/docs/measure.md has its keys), in which every strip
// and path-traced picture also has its `pictures` as data: URIs.

function escaped(text) {
  return String(text).replace(/[&<>"]/g, c => ({ '&': '&amp;', '<': '&lt;', '>': '&gt;', '"': '&quot;' })[c]);
}

/** Three digits; a dash for what is not there. */
function digits(value) {
  if (value === null) return '–';
  const size = Math.abs(value);
  return size >= 100 && size < 1e6 ? value.toFixed(0) : String(Number(value.toPrecision(3)));
}
const percent = value => value === null ? '–' : `${(100 * value).toFixed(0)} %`;
const fixed = value => value === null ? '–' : value.toFixed(2);

/** A cell that sorts by its value. */
function cell(value, text = digits(value)) {
  return `<td data-v="${value === null ? NaN : value}">${text}</td>`;
}

const image = (uri, alternative) => `<img alt="${escaped(alternative)}" src="${uri}">`;
const capital = text => text[0].toUpperCase() + text.slice(1);
const byScore = accuracy => row => row[`score_${accuracy}`] === null ? Infinity : row[`score_${accuracy}`];

function setName(report, set) {
  const white = report.color.every(c => c === 1);
  return (set.rays === 'camera' ? 'Camera rays' : 'Secondary rays') +
    (set.depth === 'own' ? `, scale ${digits(set.scale)}` : `, depth ${digits(set.depth)}`) +
    (!set.coloured ? '' : white ? ', in colour' : `, colour ${report.color.map(digits).join(', ')}`);
}

const setTitle = (report, set) => `<b>${setName(report, set)}</b> · ${set.ray_count} rays, mean optical depth ` +
  `${digits(set.mean_depth)}, mean transmittance ${digits(set.mean_transmittance)}`;

const kFamilies = [
  { title: 'delta', color: '#444444', shape: 'cross', holds: r => r.method === 'delta' },
  { title: 'ratio', color: '#1f77b4', shape: 'square', holds: r => r.method === 'ratio' },
  ...[['constant', '#ff9f1c', 'circle'], ['affine', '#d62728', 'triangle'], ['trilinear', '#9467bd', 'diamond']].map(
    ([kind, color, shape]) => ({
      title: `residual, ${kind}`, color, shape, holds: r => r.method === 'residual' && r.control === kind
    })),
  { title: 'control (biased)', color: '#2ca02c', shape: 'box', holds: r => r.method === 'control' },
  { title: 'comb', color: '#17becf', shape: 'square', holds: r => r.method === 'comb' },
  { title: 'march (biased)', color: '#8c564b', shape: 'plus', holds: r => r.method === 'march' }
];

/** Below, an error is that of floats; it would stretch the axis. */
const kNoError = 1e-7;

function setPlot(set) {
  const shown = set.rows.filter(r => r.rmse > kNoError && r.converged);
  const point = r => ({ x: r.time_ns, y: r.rmse, title: `${r.way}: ${digits(r.time_ns)} ns, RMSE ${digits(r.rmse)}` });
  const series = kFamilies.map(f => ({ ...f, points: shown.filter(f.holds).map(point) })).filter(f => f.points.length > 0);
  if (series.length === 0) {
    return '<p>Nothing to plot: no way with an error converged here. Where transmittances are not all next to 0 or 1, ' +
      'more rounds or rays help.</p>';
  }
  const front = shown.filter(r => r.front).map(point).sort((a, b) => a.x - b.x);
  const exact = set.rows.find(r => r.method === 'exact');
  return plotOf({
    xTitle: 'time a ray (ns)', yTitle: 'RMSE of one estimate', series, front,
    vertical: exact ? { x: exact.time_ns, title: 'exact' } : null,
    trade: front.length > 0 ? front[0].x * front[0].y ** 2 : null
  });
}

function plots(report, coloured) {
  return '<div class="plots">' + report.sets.filter(s => s.coloured === coloured).map(s =>
    `<figure><figcaption>${setTitle(report, s)}</figcaption>${setPlot(s)}</figure>`).join('') + '</div>';
}

function trade(report) {
  const grey = report.sets.some(s => !s.coloured), coloured = report.sets.some(s => s.coloured);
  return `<h2 id="trade">Time against error</h2>
<p>One point a way: control, choice, size and rate are under the mouse. Left and low is good. Averaging samples moves a
point along a pale line; the black steps are the ways that no other unbiased one beats in both. The dotted line is the
exact method, without error. Time: median of ${report.rounds} rounds over all rays, one pinned thread, ways
interleaved.</p>` + (grey ? plots(report, false) : '') +
    (coloured ? `<details${grey ? '' : ' open'}><summary>In colour</summary>${plots(report, true)}</details>` : '');
}

/** The best `most` rows of a set: those that rank, by their score, then the others. */
function setTable(set, most) {
  const ranks = r => r.converged && r.unbiased;
  const score = byScore('normal');
  const rows = [...set.rows].sort((a, b) => ranks(b) - ranks(a) || (score(a) < score(b) ? -1 : score(a) > score(b) ? 1 : 0));
  const body = rows.slice(0, most).map(r => {
    const costs = ['ratio_rough', 'ratio_normal', 'ratio_tight', 'delta_normal'].map(name =>
      ranks(r) ? cell(r[`cost_over_${name}`]) : cell(null, ''));
    const remark = !r.converged ? 'not converged' : !r.unbiased ? 'biased' : r.front ? 'front' : '';
    return `<tr class="${r.front ? 'front' : ranks(r) ? '' : 'off'}"><td>${r.way}</td>${cell(r.time_ns)}` +
      cell(r.time_spread, percent(r.time_spread === null ? null : r.time_spread / 2)) + cell(r.lookups) +
      cell(r.super_voxels) + cell(r.exact_share, percent(r.exact_share)) + cell(r.variance) + cell(r.rmse) +
      cell(r.z, fixed(r.z)) + costs.join('') + `<td>${remark}</td></tr>`;
  });
  return '<div class="scroll"><table class="sort"><thead><tr><th>way</th><th>time, ns</th><th>±</th><th>look-ups</th>' +
    '<th>super-voxels</th><th>exact</th><th>variance</th><th>RMSE</th><th>bias, z</th><th>rough</th><th>normal</th>' +
    `<th>tight</th><th>of delta</th><th></th></tr></thead><tbody>${body.join('\n')}</tbody></table></div>`;
}

function tables(report) {
  const kFirst = 10;
  return `<h2 id="tables">Measurements</h2>
<p>Per ray and estimate. <i>±</i>: half of the spread of the middle half of the times. <i>Exact</i>: the share of the
length that was integrated exactly. <i>Rough, normal, tight</i>: cost over that of ratio tracking at the size nearest to
16, rate 1, where cost is (V0 + variance) × time and V0, the variance a renderer has from elsewhere, 0.1, 0.01 and 0.001;
<i>of delta</i>: the normal one over delta tracking's. Below 1 is better. Bold: nothing unbiased is both faster and as
good. A click on a heading sorts. The same numbers are in <code>measurements.csv</code> and
<code>measurements.json</code>.</p>` + report.sets.map((s, i) =>
    `<details${i < 2 ? ' open' : ''}><summary>${setTitle(report, s)}</summary>${setTable(s, kFirst)}` +
    (s.rows.length > kFirst ? `<details><summary>All ${s.rows.length} ways</summary>${setTable(s, s.rows.length)}</details>` : '') +
    '</details>').join('\n');
}

function strips(report) {
  if (report.strips.length === 0) return '';
  const bar = texts => `<td><div class="bar" style="background:url(${report.scale_bar}) 0/100% 100%"></div>` +
    `<div class="scale">${texts.map(t => `<span>${t}</span>`).join('')}</div></td>`;
  return `<h2 id="strips">What each choice of the control leaves to chance</h2>
<p>The volume seen from a corner, grey, at a mean optical depth of ${digits(report.strip_depth)}. An estimate is the
product of the <i>control's</i> transmittance, which is known, and the <i>residual's</i>, which is estimated; here 16
estimates a pixel, without roulette and exact integration, which would hide the noise. Where the control is above the
extinction, the residual's transmittance exceeds 1 and the noise grows. Green: not a number to show.</p>` +
    report.strips.map(strip => `<h3>${strip.size === 'all' ? 'One control for the whole volume'
      : `A constant control per super-voxel of ${strip.size} voxels`}</h3>
<div class="scroll"><table class="strip"><tr><th></th><th>control</th><th>residual</th><th>product</th><th>variance</th></tr>` +
      strip.rows.map(r => `<tr><td>${r.choice}<br><span class="n">${digits(r.variance)}</span></td>` +
        ['control', 'residual', 'product', 'variance'].map(what =>
          `<td>${image(r.pictures[what], `${r.choice}, ${what}`)}</td>`).join('') + '</tr>').join('\n') +
      `<tr><td></td>${bar(['0', '1'])}${bar(['1/8', '1', '8'])}${bar(['0', '1'])}${bar(['1e-6', '1e-3', '1'])}</tr></table></div>
<p class="lead">Under the names: the mean variance of one estimate, as far as 16 samples a pixel show it.</p>`).join('\n');
}

function bakes(report) {
  return '<h2 id="bakes">What a bake costs</h2><table class="sort"><thead><tr><th>control</th><th>size</th>' +
    '<th>super-voxels</th><th>bake, ms</th><th>sidecar, kB</th><th>residual left, % of the density\'s RMS</th></tr>' +
    '</thead><tbody>' + report.bakes.map(b => `<tr><td>${b.control}</td>${cell(b.size)}` +
      cell(b.super_voxels, String(b.super_voxels)) + cell(1000 * b.seconds) + cell(b.sidecar_bytes / 1000) +
      `${cell(b.residual_share === null ? null : 100 * b.residual_share)}</tr>`).join('\n') +
    '</tbody></table><p class="lead">All threads; without reading the density and writing the sidecar, which has 4 ' +
    'preview levels.</p>';
}

function scattering(report) {
  const scene = report.dual_scattering;
  if (!scene) return '';
  const error = p => cell(p.rmse, `${digits(p.rmse)} (${digits(p.shadow_rmse)})`);
  const pictures = (title, which) => `<h3>${title}</h3><div class="pictures">` + scene.methods.map(m =>
    `<figure>${image(m[which].picture, m.shadow_rays)}<figcaption>${m.shadow_rays}, ${m[which].samples} paths: RMSE ` +
    `${digits(m[which].rmse)}</figcaption></figure>`).join('\n') +
    `<figure>${image(scene.reference_picture, 'converged')}<figcaption>converged, ${scene.reference_samples} paths` +
    '</figcaption></figure></div>';
  return `<h2 id="scattering">Dual scattering</h2>
<p>A path tracer on the C API: at most two bounces, a sun and a sky, albedo 0.98, Henyey-Greenstein with g = 0.4; colour
${scene.color.map(digits).join(', ')}, mean optical depth without it ${digits(scene.depth)}; super-voxels:
${scene.control}. Only the shadow rays differ; free paths and directions are the same. Delta tracking has
${scene.delta_samples} paths a pixel; the others have as many as cost the same in look-ups of all rays, or in time. RMSE
over the pixels that show the volume, against a picture of ${scene.reference_samples} paths a pixel; in brackets what of
it comes from the shadow rays: the RMSE against the same paths with exact ones.</p>
<div class="scroll"><table><thead><tr><th>shadow rays</th><th>look-ups a path</th><th>in shadow rays</th><th>ns a path</th>
<th>±</th><th>same paths</th><th colspan="2">equal look-ups: paths, RMSE</th><th colspan="2">equal time: paths, RMSE</th>
</tr></thead><tbody>` + scene.methods.map(m => `<tr><td>${m.shadow_rays}</td>${cell(m.lookups)}${cell(m.shadow_lookups)}` +
    cell(m.time_ns) + cell(m.time_spread, percent(m.time_spread / 2)) + error(m.same_samples) +
    cell(m.equal_lookups.samples) + error(m.equal_lookups) + cell(m.equal_time.samples) +
    `${error(m.equal_time)}</tr>`).join('\n') + '</tbody></table></div>' +
    pictures('Equal look-ups', 'equal_lookups') + pictures('Equal time', 'equal_time');
}

function recommendation(report) {
  return '<h2 id="recommendation">Recommendation</h2>' +
    (report.no_recommendation ? `<p>${report.no_recommendation}</p>` : '') +
    report.recommendation.map(a => `<div class="advice"><h3>${capital(a.accuracy)} accuracy: ${escaped(a.way)}</h3>
<p>For a renderer with a variance of ${digits(a.variance_elsewhere)} from elsewhere. ` +
      (a.bake === '' ? 'No sidecar is needed; '
        : `<code>${escaped(report.bake_command)} ${escaped(a.bake)}</code>, then `) +
      `<code>${escaped(a.query)}</code>.</p><ul>${a.why.map(w => `<li>${escaped(w)}</li>`).join('\n')}</ul></div>`).join('\n');
}

function checks(report) {
  const rows = report.sets.flatMap(s => s.rows);
  const tested = rows.filter(r => r.unbiased && r.z !== null).map(r => Math.abs(r.z));
  const largest = Math.max(...tested);
  const unconverged = rows.filter(r => !r.converged).length;
  return (tested.length > 0 ? `<p>Every unbiased way that converged was checked against the exact value: ${tested.length} ` +
    `rows, largest |z| ${fixed(largest)}, of which ${largest < report.z_bound ? 'none' : 'one or more'} exceeds ` +
    `${fixed(report.z_bound)}, the bound for all of them together (Šidák, 1 %).</p>` : '') +
    (unconverged > 0 ? `<p>${unconverged} rows are marked <i>not converged</i>: a single estimate carries more than 5 % ` +
      'of the sum, or the formula knows of variance that the sample does not show. They rank nowhere, and nothing is ' +
      'said of their bias.</p>' : '');
}

function head(report) {
  const short = report.recommendation.map(a => `for ${a.accuracy} accuracy ${escaped(a.way)}`).join('; ');
  return `<h1>${escaped(report.input)}: what accuracy costs</h1>
<p class="lead">Grid ${escaped(report.grid || '(unnamed)')}, ${report.active_voxels} active voxels in a box of
${report.box.join(' × ')}. vdbtrack ${report.tool_version}, ${report.sets.reduce((n, s) => n + s.rows.length, 0)} rows in
${report.seconds.toFixed(0)} s: <code>${escaped(report.command)}</code></p>` +
    (short ? `<p><b>In short:</b> ${short}. <a href="#recommendation">Why</a>.</p>` : '');
}

const pageOf = report => [head, checks, trade, strips, tables, bakes, scattering, recommendation].map(part => part(report)).join('\n');

/** Sorts tables of class "sort" by the heading that is clicked; what is no number comes last. */
function makeSortable(table) {
  table.querySelectorAll('th').forEach((heading, column) => {
    heading.title = 'sort';
    heading.onclick = () => {
      const direction = heading.dataset.direction = heading.dataset.direction === '1' ? '-1' : '1';
      const value = row => {
        const v = row.cells[column].dataset.v;
        return v === undefined ? row.cells[column].textContent : Number(v);
      };
      [...table.tBodies[0].rows].sort((a, b) => {
        const x = value(a), y = value(b);
        if (typeof x === 'string') return direction * x.localeCompare(y);
        return isNaN(x) ? 1 : isNaN(y) ? -1 : direction * (x - y);
      }).forEach(row => table.tBodies[0].append(row));
    };
  });
}

const main = document.createElement('main');
main.innerHTML = pageOf(JSON.parse(document.getElementById('report').textContent));
document.body.append(main);
document.querySelectorAll('table.sort').forEach(makeSortable);
