"""Opens every page of the site in a browser and lists its faults: `python tests/site_browser.py FOLDER`."""

import contextlib
import functools
import http.server
import json
import pathlib
import shutil
import sys
import tempfile
import threading
import time
import urllib.error
import urllib.parse
import urllib.request

VERSION = "/0.1"
SIZES = {"phone": (390, 844), "desk": (1280, 900)}
OPTIONS = (
    "--headless=new --no-sandbox --disable-gpu --disable-quic --disable-dev-shm-usage --no-first-run --no-default-browser-check "
    "--disable-background-networking --disable-component-update --disable-sync --hide-scrollbars"
)
LOOK = r"""
const raw = [], walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
while (walker.nextNode()) {
  const parent = walker.currentNode.parentElement, text = walker.currentNode.data;
  if (!parent.closest("code, pre, script, style, noscript, textarea, .katex") && /\$|\\[a-zA-Z]+|\\[(\[]/.test(text)) raw.push(text.trim());
}
const all = selector => [...document.querySelectorAll(selector)];
const scrolls = element => element && element !== document.body
  && (/auto|scroll|hidden|clip/.test(getComputedStyle(element).overflowX) || scrolls(element.parentElement));
return {
  raw,
  unset: all(".arithmatex").filter(e => !e.querySelector(".katex")).map(e => e.textContent)
    .concat(all(".katex-error").map(e => e.title || e.textContent)),
  formulas: all(".katex").length,
  images: all("img[src]").filter(e => !e.naturalWidth).map(e => e.src.slice(0, 100)),
  links: all("a[href]").map(e => e.href),
  ids: all("[id], a[name]").flatMap(e => [e.id, e.getAttribute("name")]).filter(Boolean),
  wide: document.scrollingElement.scrollWidth - innerWidth,
  cut: all(".md-content *").filter(e => e.getBoundingClientRect().right > innerWidth + 1 && e.getBoundingClientRect().width && !scrolls(e))
    .map(e => e.tagName + "." + e.className + " " + e.textContent.trim().slice(0, 40)).slice(0, 3),
};
"""


class _AsMike(http.server.SimpleHTTPRequestHandler):
    """The site in a folder of its version, beside a list of versions, as `mike` lays it out; and at the root."""

    def log_message(self, *args):
        pass

    def translate_path(self, path):
        return super().translate_path(path.removeprefix(VERSION))

    def do_GET(self):
        if self.path == "/versions.json":
            name = VERSION.strip("/")
            body = json.dumps([{"version": name, "title": name, "aliases": []}]).encode()
            self.send_response(200)
            self.send_header("Content-Type", "application/json")
            self.end_headers()
            self.wfile.write(body)
        else:
            super().do_GET()


@contextlib.contextmanager
def served(folder):
    """The address at which the files of a folder are served."""
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(_AsMike, directory=folder)) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


def chromium():
    """The programs of the browser and of its driver, None where there is none."""
    browser = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    return browser, shutil.which("chromedriver")


@contextlib.contextmanager
def browser():
    """A browser without a window, which remembers nothing."""
    from selenium import webdriver

    program, driver = chromium()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        options = webdriver.ChromeOptions()
        options.binary_location = program
        for option in [*OPTIONS.split(), f"--user-data-dir={profile}"]:
            options.add_argument(option)
        options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
        window = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
        try:
            yield window
        finally:
            window.quit()


def resize(window, width, height, dark=False):
    """The page as on a screen of this size."""
    metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
    window.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
    window.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [scheme]})


def faults(folder):
    """What is wrong, as (page, size, fault, what), the number of pages, and that of formulas."""
    pages = sorted(file.relative_to(folder).as_posix() for file in pathlib.Path(folder).rglob("*.html"))
    found, seen = [], {}
    with served(folder) as address, browser() as window:
        for size, (width, height) in SIZES.items():
            resize(window, width, height)
            for page in pages:
                folder_of_page = "" if page == "404.html" else VERSION  # its links begin at the root
                seen[page], of_page = _look(window, f"{address}{folder_of_page}/{page.removesuffix('index.html')}", size)
                found += [(page, size, *fault) for fault in of_page]
        found += _dead_links(address, seen)
    return found, len(pages), sum(look["formulas"] for look in seen.values())


def _look(window, url, size):
    """What the browser sees on a page, and its faults."""
    window.get(url)
    window.execute_script("document.querySelectorAll('img').forEach(image => { image.loading = 'eager'; })")
    deadline = time.monotonic() + 5.0
    while window.execute_script("return [...document.images].some(image => image.getAttribute('src') && !image.complete)"):
        if time.monotonic() > deadline:
            break
        time.sleep(0.02)
    look = window.execute_script(LOOK)
    found = [("raw formula", text) for text in look["raw"]] + [("formula not set", text) for text in look["unset"]]
    found += [("broken picture", source) for source in look["images"]]
    found += [("console", entry["message"]) for entry in window.get_log("browser") if entry["level"] == "SEVERE"]
    if size == "phone":
        found += [("scrolls sideways", f"by {look['wide']} px")] if look["wide"] > 0 else []
        found += [("beyond the edge", element) for element in look["cut"]]
    return look, found


def _dead_links(address, seen):
    """Links to pages, files and anchors of this site that do not exist."""
    ids = {f"/{page.removesuffix('index.html')}": set(look["ids"]) for page, look in seen.items()}
    exists = functools.cache(lambda path: path in ids or _answers(address + path))
    for page, look in seen.items():
        for link in sorted({link for link in look["links"] if link.startswith(f"{address}/")}):
            parts = urllib.parse.urlsplit(link)
            path = parts.path.removeprefix(VERSION).removesuffix("index.html")
            anchor = urllib.parse.unquote(parts.fragment)
            if not exists(path):
                yield page, "any", "dead link", parts.path
            elif anchor and path in ids and anchor not in ids[path]:
                yield page, "any", "no such anchor", f"{path}#{anchor}"


def _answers(url):
    try:
        with urllib.request.urlopen(url, timeout=10.0) as answer:
            return answer.status == 200
    except urllib.error.HTTPError:
        return False


def table(found):
    """Faults by page; each once, with the sizes at which it was seen."""
    lines = {}
    for page, size, fault, what in found:
        lines.setdefault((page, fault, " ".join(what.split())[:120]), []).append(size)
    width = max((len(page) for page, *_ in lines), default=0)
    return "\n".join(f"{page:{width}}  {fault:16}  {'+'.join(sizes):10}  {what}" for (page, fault, what), sizes in sorted(lines.items()))


if __name__ == "__main__":
    begin = time.monotonic()
    found, pages, formulas = faults(sys.argv[1])
    print(table(found))
    print(f"{pages} pages, {formulas} formulas, {len(found)} faults, {time.monotonic() - begin:.0f} s")
    sys.exit(bool(found))
