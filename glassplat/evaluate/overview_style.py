"""Style and script of the overview page, inlined so that the page needs no other file than its pictures."""

STYLE = """
:root { color-scheme: dark }
body { margin: 0 auto; max-width: 1700px; padding: 24px; background: #16181c; color: #ececec;
       font: 15px/1.5 system-ui, sans-serif }
h1 { margin: 0; font-size: 24px; font-weight: 600 }
a { color: inherit }
.settings { margin: 4px 0 20px; color: #a0a6ae }
.settings b { color: #ececec; font-weight: 500 }
.settings p { margin: 0 }
.cards { display: flex; flex-wrap: wrap; gap: 10px; margin-bottom: 20px }
.cards div { min-width: 118px; padding: 10px 14px; border-radius: 8px; background: #22252b }
.cards b { display: block; font-size: 19px; font-weight: 600; font-variant-numeric: tabular-nums }
.cards span { color: #a0a6ae; font-size: 13px }
.scroll { overflow-x: auto; margin-bottom: 20px }
table { border-collapse: collapse; font-variant-numeric: tabular-nums }
th { color: #a0a6ae; font-weight: 400 }
th, td { padding: 3px 18px 3px 0; text-align: right; border-bottom: 1px solid #2b2f36 }
th:first-child, td:first-child { text-align: left }
figure { margin: 0 0 20px; scroll-margin-top: 12px }
figure img { display: block; width: 100%; height: auto; border-radius: 8px; border: 1px solid #2b2f36;
             box-sizing: border-box; cursor: zoom-in }
.meanings { color: #a0a6ae; font-size: 13px }
.meanings h2 { margin: 24px 0 8px; font-size: 15px; font-weight: 600; color: #ececec }
.meanings dl { display: grid; grid-template-columns: max-content 1fr; gap: 2px 18px; margin: 0 0 8px }
.meanings dt { color: #ececec }
.meanings dd { margin: 0 }
dialog { max-width: none; max-height: none; width: 100vw; height: 100vh; padding: 0; border: 0; overflow: auto;
         background: #0c0d0f; cursor: zoom-out; box-sizing: border-box }
dialog img { display: block; margin: auto; min-width: 100% }
"""

# Without scripts the links open the picture itself.
SCRIPT = """
const large = document.getElementById("large");
for (const link of document.querySelectorAll("figure a"))
  link.addEventListener("click", event => {
    event.preventDefault();
    large.firstElementChild.src = link.href;
    large.showModal();
  });
large.addEventListener("click", () => large.close());
"""
