// SPDX-License-Identifier: Apache-2.0
// How the page of `vdbtrack measure` looks, and what it does by itself.
#pragma once

namespace apps {

inline constexpr char kStyle[] = R"(
:root { color-scheme: light; }
body { font: 16px/1.5 system-ui, sans-serif; color: #222; background: #fafafa; margin: 0 auto; max-width: 1280px;
  padding: 1.5rem; }
h1 { font-size: 1.7rem; margin: 0 0 .2rem; } h2 { font-size: 1.3rem; margin: 2.4rem 0 .4rem; border-top: 1px solid #ddd;
  padding-top: 1.2rem; } h3 { font-size: 1.05rem; margin: 1.4rem 0 .3rem; }
p { max-width: 52rem; margin: .5rem 0; } code, .n { font-family: ui-monospace, monospace; font-size: .92em; }
code { background: #eee; padding: .05em .3em; border-radius: 3px; overflow-wrap: anywhere; }
.lead { color: #555; } .advice { background: #fff; border: 1px solid #ddd; border-left: 5px solid #d62728; border-radius: 6px;
  padding: .7rem 1rem; margin: .8rem 0; } .advice p { max-width: none; } .advice h3 { margin: 0 0 .3rem; } .advice ul { margin: .3rem 0; padding-left: 1.3rem; }
.plots { display: grid; grid-template-columns: repeat(auto-fit, minmax(480px, 1fr)); gap: 1rem; }
figure { margin: 0; background: #fff; border: 1px solid #ddd; border-radius: 6px; padding: .5rem; }
figcaption { font-size: .9rem; padding: 0 .3rem .3rem; } svg { width: 100%; height: auto; }
.scroll { overflow-x: auto; } table { border-collapse: collapse; font-size: .84rem; background: #fff; margin: .4rem 0; }
th, td { padding: .22rem .55rem; border: 1px solid #e2e2e2; text-align: right; white-space: nowrap; }
th { background: #f0f0f0; text-align: center; font-weight: 600; } th.s { cursor: pointer; } td:first-child { text-align: left; }
tr.front td:first-child { font-weight: 600; } tr.off td { color: #999; } tr:hover td { background: #f6f8ff; }
details { margin: .6rem 0; } summary { cursor: pointer; } .strip td { text-align: center; padding: .25rem; }
.strip td:first-child { font-weight: 600; padding: 0 .8rem; }
.pictures { display: grid; grid-template-columns: repeat(auto-fit, minmax(200px, 1fr)); gap: .8rem; }
img { display: block; image-rendering: pixelated; width: 100%; } .strip img { width: 168px; }
.bar { height: 12px; border: 1px solid #aaa; } .scale { display: flex; justify-content: space-between; font-size: .78rem; }
)";

/// Sorts the tables of class "sort" by the heading that is clicked.
inline constexpr char kScript[] = R"(
document.querySelectorAll('table.sort').forEach(t => t.querySelectorAll('th').forEach((h, i) => {
  h.classList.add('s'); h.title = 'sort';
  h.onclick = () => { const b = t.tBodies[0], d = h.dataset.d = h.dataset.d === '1' ? '-1' : '1';
    const v = r => { const x = r.cells[i].dataset.v; return x === undefined ? r.cells[i].textContent : +x; };
    [...b.rows].sort((p, q) => { const x = v(p), y = v(q);
      return d * (typeof x === 'string' ? x.localeCompare(y) : (isNaN(x) ? 1 : isNaN(y) ? -1 : x - y)); })
      .forEach(r => b.append(r)); }; }));
)";

}  // namespace apps
