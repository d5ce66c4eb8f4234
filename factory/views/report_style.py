"""The style of report.html and of the dashboard: system fonts, both colour schemes, one column on a phone."""

LIGHT = (
    "--bg:#f6f7f8;--card:#fff;--ink:#1b2026;--dim:#68727d;--line:#e3e6e9;--track:#eceff1;--accent:#2078c8;"
    "--good:#1f8a5f;--bad:#c9463a;--warn:#b7791f;--cell:#e9f0f6;--perturbed:#e07a20;--logged:#6e6e6e"
)
DARK = (
    "--bg:#12161b;--card:#1a2027;--ink:#e6eaee;--dim:#95a1ad;--line:#2c343d;--track:#2a323b;--accent:#5aa5ea;"
    "--good:#4fc08d;--bad:#ef7a6d;--warn:#e0ac52;--cell:#222c37;--logged:#a5a5a5"
)
COLOURS = f"""
:root{{{LIGHT}}}
@media (prefers-color-scheme:dark){{:root{{{DARK}}}}}
"""
STYLE = (
    COLOURS
    + """*{box-sizing:border-box}
body{margin:0;background:var(--bg);color:var(--ink);font:15px/1.5 system-ui,-apple-system,"Segoe UI",Roboto,sans-serif}
main{max-width:1120px;margin:0 auto;padding:28px 20px 60px}
header,section,details{background:var(--card);border:1px solid var(--line);border-radius:12px;
padding:22px 24px;margin:0 0 18px}
header>div:first-child{display:flex;flex-wrap:wrap;gap:12px;align-items:center}
h1{font-size:24px;line-height:1.2;margin:0;letter-spacing:-.01em}
h2{font-size:18px;margin:0 0 2px}
h3{font-size:14px;margin:20px 0 8px;overflow-wrap:anywhere}
small{display:block;color:var(--dim);font-weight:400;font-size:12px}
.lead,.path,.note,.nothing{color:var(--dim);margin:2px 0 12px;font-size:13.5px;max-width:80ch}
.path{font-family:ui-monospace,Menlo,Consolas,monospace;font-size:12.5px;overflow-wrap:anywhere;max-width:none}
.nothing{font-style:italic}
.dim{color:var(--dim)}
.pill{font-size:12.5px;font-weight:600;border-radius:99px;padding:2px 11px;border:1px solid currentColor}
.pill.good{color:var(--good)}.pill.warn{color:var(--warn)}.pill.bad{color:var(--bad)}.pill.plain{color:var(--dim);font-weight:500}
.tiles{display:grid;grid-template-columns:repeat(auto-fit,minmax(150px,1fr));gap:12px;margin:16px 0}
.tile{border:1px solid var(--line);border-radius:10px;padding:12px 14px}
.tile b{display:block;font-size:26px;line-height:1.15;font-variant-numeric:tabular-nums}
.tile span{font-size:13px}
dl{display:grid;grid-template-columns:repeat(auto-fit,minmax(240px,1fr));gap:8px 22px;margin:0}
dl div{border-top:1px solid var(--line);padding-top:6px}
dt{color:var(--dim);font-size:12px}
dd{margin:0;overflow-wrap:anywhere;font-size:14px}
.wide{overflow-x:auto;-webkit-overflow-scrolling:touch}
table{border-collapse:collapse;width:100%;font-size:13.5px}
th,td{text-align:left;padding:6px 14px 6px 0;border-bottom:1px solid var(--line);vertical-align:top}
thead th{color:var(--dim);font-weight:500;font-size:12px;vertical-align:bottom}
tbody th{font-weight:600;white-space:nowrap}
table.failed th,table.settings th,table.left-out th{white-space:normal;overflow-wrap:anywhere}
tbody tr:last-child>*{border-bottom:0}
.n{font-variant-numeric:tabular-nums;white-space:nowrap}
table.settings th,table.settings td,td pre{font-family:ui-monospace,Menlo,Consolas,monospace;font-size:12px}
table.settings td{overflow-wrap:anywhere}
pre{margin:0;white-space:pre-wrap;overflow-wrap:anywhere;max-height:14em;overflow-y:auto;min-width:280px}
.bar{display:flex;align-items:center;gap:9px;min-width:130px}
.track{position:relative;flex:1;height:10px;border-radius:5px;background:var(--track)}
.track>span{display:block;height:100%;border-radius:5px;background:var(--accent)}
.track>i{position:absolute;top:-4px;bottom:-4px;width:2px;background:var(--perturbed)}
.count .track{max-width:260px}
.value{font-variant-numeric:tabular-nums;min-width:54px;white-space:nowrap}
.keys{display:flex;flex-wrap:wrap;gap:4px 20px;font-size:13px;margin:4px 0 10px}
.keys span{display:inline-flex;align-items:center;gap:7px}
.key{width:20px;height:3px;border-radius:2px;background:var(--dim)}
.key.perturbed{background:#e07a20}.key.expert{background:#2078c8}
.key.ego{height:12px;width:7px;background:#1e1e1e;border:1px solid var(--dim)}
.key.logged{height:0;background:none;border-top:3px dotted var(--logged)}
.cards{display:grid;grid-template-columns:repeat(auto-fill,minmax(270px,1fr));gap:16px}
.cams{display:grid;grid-template-columns:repeat(auto-fill,minmax(200px,1fr));gap:10px;align-items:start}
.cams.small{grid-template-columns:repeat(auto-fill,minmax(130px,1fr));margin-top:10px}
.strip+.strip{border-top:1px solid var(--line);margin-top:18px}
figure{margin:0;border:1px solid var(--line);border-radius:10px;overflow:hidden;background:var(--bg)}
figure.accepted{border-top:3px solid var(--good)}figure.rejected{border-top:3px solid var(--bad)}
figure img{display:block;width:100%;height:auto}
figcaption{padding:8px 11px 9px;font-size:13px;overflow-wrap:anywhere}
.cams figcaption{padding:4px 8px;font-size:12px}
.missing{padding:34px 10px;text-align:center;color:var(--dim);font-size:13px}
svg{display:block;width:100%;min-width:620px;height:auto}
svg.inline{width:14px;min-width:14px}
svg text{fill:var(--dim);font-size:12px}svg .axis{font-size:13px}
.cell{fill:var(--cell)}.zero{stroke:var(--dim);stroke-width:1;stroke-dasharray:4 4;opacity:.6}
.mark{fill:none;stroke-width:1.5}
.mark.accepted{fill:var(--good);stroke:var(--card);stroke-width:1}.mark.rejected{stroke:var(--bad)}
.mark.failed{fill:var(--warn)}.mark.untried{stroke:var(--dim);stroke-width:1.1;opacity:.75}
summary{cursor:pointer;font-weight:600}
details[open] summary{margin-bottom:10px}
@media (max-width:600px){main{padding:10px 8px 40px}header,section,details{padding:16px 14px;border-radius:10px}}
@media print{body{background:#fff}section,header{break-inside:avoid}}
"""
)
