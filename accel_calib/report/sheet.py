# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The style sheet of the report, for desktops, phones and paper."""

SHEET = """
html { font: 17px/1.5 "DejaVu Sans", Verdana, "Segoe UI", sans-serif; color: #222;
  background: #fff; }
body { margin: 0; }
main { max-width: 980px; margin: 0 auto; padding: 1.2rem 1rem 3rem; }
h1 { font-size: 1.7rem; line-height: 1.2; margin: .4rem 0 0; }
h2 { font-size: 1.2rem; line-height: 1.3; margin: 0 0 .4rem; }
p, ul { margin: .5rem 0 .8rem; max-width: 46rem; }
ul { padding-left: 1.2rem; }
li { margin: .25rem 0; }
code { font: .92em "DejaVu Sans Mono", Consolas, monospace; background: #f2f2f2;
  padding: .05em .25em; border-radius: 3px; overflow-wrap: anywhere; }
section { border-top: 1px solid #ddd; margin-top: 1.8rem; padding-top: 1.2rem; }
.about { color: #666; font-size: .85rem; overflow-wrap: anywhere; }
.verdict { font-size: 1.1rem; font-weight: bold; border-left: 6px solid #0072b2;
  background: #eef5fa; padding: .6rem .9rem; max-width: none; }
.verdict.unexplained { border-color: #d55e00; background: #fdf2ea; }
.verdict.no_gap { border-color: #009e73; background: #ebf7f3; }
.numbers { display: flex; flex-wrap: wrap; gap: .6rem 2.2rem; margin: 1rem 0; }
.numbers dt { color: #666; font-size: .8rem; }
.numbers dd { margin: 0; font-size: 1.35rem; }
.figures { display: grid; gap: .8rem 1.2rem; margin: 1rem 0; }
.figures.pair { grid-template-columns: repeat(auto-fit, minmax(min(100%, 400px), 1fr)); }
figure { margin: 0; break-inside: avoid; }
figure svg { display: block; width: 100%; height: auto; }
.wide figure { max-width: 640px; }
.whole { white-space: nowrap; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: .88rem; margin: .6rem 0; }
th { text-align: left; color: #666; font-weight: normal; border-bottom: 2px solid #ddd; }
td { border-bottom: 1px solid #eee; }
th, td { padding: .3rem 1.1rem .3rem 0; vertical-align: top; }
.reading { color: #444; font-size: .9rem; }
@media (max-width: 600px) { html { font-size: 16px; } h1 { font-size: 1.4rem; }
  table { font-size: .8rem; } th, td { padding-right: .7rem; } }
@media print { html { font-size: 11pt; } main { max-width: none; padding: 0; }
  section { break-inside: avoid-page; } .figures.pair { grid-template-columns: 1fr 1fr; } }
"""
