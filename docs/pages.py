"""Gathers the pages of the site: README and its companions, a gallery of the notebooks, and a reference of all public names by topic."""

import base64
import json
import logging
import posixpath
import re
from pathlib import Path

HERE = Path(__file__).parent
ROOT, PAGES = HERE.parent, HERE / "pages"
TEXTS = {  # files of the repository, and the pages they become
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "docs/architecture.md": "architecture.md",
    "CITATION.cff": "CITATION.cff",
}
REFERENCE = {  # names in `jaxlag`
    "Systems": "System Contact NewtonRestitution PoissonRestitution Event direction.Falling direction.Rising direction.Negative "
    "Every State Sampled virtual_work rate substitute Signal Multisine Chirp interpolation.ZeroOrderHold interpolation.Linear "
    "interpolation.Cubic dissipation.sliding dissipation.viscous dissipation.drag dissipation.power_law "
    "dissipation.stribeck dissipation.speed",
    "Bodies in space": "rigid.rotation_x rigid.rotation_y rigid.rotation_z rigid.rotation rigid.euler rigid.Euler rigid.quaternion "
    "rigid.unit rigid.to_quaternion rigid.quaternion_rate rigid.rotation_vector rigid.angular_velocity "
    "rigid.kinetic_energy rigid.frame rigid.Frame rigid.spherical rigid.revolute rigid.prismatic rigid.cylindrical "
    "rigid.universal rigid.fixed rigid.same_axes rigid.on_plane rigid.length rigid.wheel_height rigid.rolling "
    "rigid.rolling_ball rigid.Touching rigid.sphere_plane rigid.box_plane rigid.capsule_plane rigid.ellipsoid_plane rigid.sphere_sphere "
    "rigid.inertia.box rigid.inertia.cylinder rigid.inertia.hollow_cylinder rigid.inertia.sphere "
    "rigid.inertia.hollow_sphere rigid.inertia.ellipsoid rigid.inertia.steiner rigid.inertia.rotated "
    "rigid.inertia.principal_axes rigid.inertia.Principal rigid.inertia.matrix rigid.inertia.physical "
    "rigid.inertia.log_cholesky rigid.inertia.Body",
    "Parts that jump or bend": "elements.gap_spring elements.end_stop elements.hunt_crossley elements.preload elements.bilinear "
    "elements.dead_zone elements.saturation elements.table elements.table_integral elements.gear elements.rope_over_pulley elements.belt "
    "elements.lossy_joint",
    "At one state": "acceleration results.Acceleration mass_matrix momentum energy constraint_jacobian constraint_residual "
    "constraint_force powers results.Residual consistent_state examine results.Examination results.Surface",
    "Motions": "simulate simulate_many results.Trajectory results.FrictionState results.ContactState results.EventState "
    "stepper results.Stepper results.StepState results.RESULTS results.Instant results.Interpolated load Dop853 Dopri5 "
    "stabilisation.Projection stabilisation.Baumgarte stabilisation.NoStabilisation StickSlip Regularised "
    "surfaces.Located surfaces.NotLocated keep_compiled",
    "Near a steady state": "equilibrium steady results.Equilibrium linearise results.LinearSystem results.Modes lowest_modes root_locus "
    "results.RootLocus results.Crossing periodic results.PeriodicOrbit "
    "equilibrium_curve results.EquilibriumCurve results.SpecialEquilibrium response_curve results.ResponseCurve "
    "results.SpecialPoint results.Measured stability_map results.StabilityMap",
    "Best motions": "optimise_motion results.OptimalMotion",
    "Identification": "Experiment Measurement ModalTest FrequencyResponseTest ResponseCurveTest "
    "fit fit_each results.Fit results.Channel results.Interval "
    "results.Prediction regress results.Regression Regress MultiStart validate results.Validation compare results.Comparison "
    "information results.Information design results.Design DOptimal AOptimal EOptimal Along Average Worst "
    "discover results.Discovery recover results.Recovery "
    "log_density results.LogDensity results.Posterior Huber learnt.ConvexDissipation learnt.PassiveDissipation learnt.Potential "
    "learnt.ConvexPotential",
    "On paper": "equations results.Equations results.LinearisedEquations to_fmu to_sympy",
    "Pictures": "plot.motion plot.phase plot.forces plot.energy plot.balance plot.friction plot.bode plot.nyquist plot.response_curve "
    "plot.equilibrium_curve plot.root_locus "
    "plot.mode_shapes plot.stability_map plot.fit plot.parameters plot.recovery plot.design plot.posterior plot.optimal_motion "
    "plot.convergence plot.equations plot.animate",
}
SHOWN = (".ipynb", ".png", ".gif", ".svg")  # files shown from the folder of notebooks
WITHOUT_TOC = "---\nhide: [toc]\n---\n"
LONGEST_TEASER = 240  # characters on a card of the gallery
LINK = re.compile(r"(?P<code>```.*?```|`[^`\n]+`)|\[(?P<label>(?:[^\[\]]|\[[^\[\]]*\])*)\]\((?P<target>[^)\s]+)\)", re.DOTALL)
log = logging.getLogger("mkdocs.hooks.pages")


def on_config(config):
    """Writes the pages before mkdocs looks for them, and enters them in its navigation."""
    shown = [file for file in (ROOT / "notebooks").iterdir() if file.suffix in SHOWN]
    pages = {page: (ROOT / source).read_bytes() for source, page in TEXTS.items()}
    pages |= {f"notebooks/{file.name}": file.read_bytes() for file in shown} | _gallery() | _reference()
    for folder in ("notebooks", "reference"):
        for file in (PAGES / folder).rglob("*.*"):
            if file.relative_to(PAGES).as_posix() not in pages:  # renamed since
                file.unlink()
    for page, content in pages.items():
        file, content = PAGES / page, content if isinstance(content, bytes) else content.encode()
        if not file.exists() or file.read_bytes() != content:  # otherwise `mkdocs serve` would start again and again
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(content)
    tutorials = [{"Gallery": "tutorials.md"}, *sorted(page for page in pages if page.endswith(".ipynb"))]
    reference = ["reference/index.md", *({topic: _reference_page(topic)} for topic in REFERENCE)]
    gathered = {"Tutorials": tutorials, "Reference": reference}
    config.nav = [{name: gathered.get(name, below)} for entry in config.nav for name, below in entry.items()]
    return config


def on_page_markdown(markdown, page, **_):
    """Turns links to files of the repository into links to their pages; a file without a page is named without a link."""
    if not page.file.src_uri.endswith(".md"):
        return markdown
    if page.parent is None:  # with nothing to navigate next to it
        page.meta["hide"] = ["navigation"]
    own = page.file.src_uri
    source = next((source for source, name in TEXTS.items() if name == own), f"docs/pages/{own}")
    return LINK.sub(lambda link: _relinked(link, posixpath.dirname(source), posixpath.dirname(own)), markdown)


def on_page_content(html, page, files, **_):
    """A notebook in the style of the other pages: without its own styles and scripts, with links to pages."""
    if not page.file.src_uri.endswith(".ipynb"):
        return html
    html = html[html.index('<div class="jupyter-wrapper">') :]
    html = html[: html.rindex("<style>")]  # of JupyterLab, half a megabyte per page
    html = re.sub(r'<link [^>]*rel="stylesheet"[^>]*>', "", html)  # external icons of an animation: assets/site.css has others
    html = re.sub(r'<div class="zeroclipboard-container">.*?</clipboard-copy>\s*</div>', "", html, flags=re.DOTALL)
    html = re.sub(r'<div class="clipboard-copy-txt".*?</div>', "", html, flags=re.DOTALL)
    code = re.compile(r'<div class="highlight-ipynb[^"]*"><pre>(.*?)</pre>', re.DOTALL)
    html = code.sub(r'<div class="highlight"><pre><code>\1</code></pre>', html)
    html = re.sub(r"<table[^>]*>", "<table>", html)
    html = html.replace('class="anchor-link"', 'class="headerlink"')
    return re.sub(r'href="(?!\w+:|#)([^"#]+)', lambda link: f'href="{_url(link[1], page, files)}', html)


def _relinked(link, folder, page_folder):
    """One link (or a piece of code, which stays as it is) of a text in `folder` of the repository, for a page in `page_folder`."""
    if link["code"] or re.match(r"\w+:|#|/", link["target"]):
        return link[0]
    target, *anchor = link["target"].split("#")
    file = posixpath.normpath(posixpath.join(folder, target))
    page = _page(file)
    if page is None:
        return link["label"] if (ROOT / file).exists() else link[0]
    return f"[{link['label']}]({'#'.join([posixpath.relpath(page, page_folder or '.'), *anchor])})"


def _page(file):
    """The page that a file of the repository becomes, or None."""
    if file == "notebooks":
        return "tutorials.md"
    if file.startswith("notebooks/") and file.endswith(SHOWN):
        return file
    return file.removeprefix("docs/pages/") if file.startswith("docs/pages/") else TEXTS.get(file)


def _url(link, page, files):
    """The URL of the page of a file that a notebook links to."""
    target = _page(posixpath.normpath(posixpath.join("notebooks", link)))
    file = files.get_file_from_path(target) if target else None
    if file is None:
        log.warning(f"{page.file.src_uri} links to {link}, which has no page")
        return link
    return file.url_relative_to(page.file)


def _gallery():
    """The page of cards, one for each notebook, and their pictures."""
    cards, thumbs = [], {}
    for file in sorted((ROOT / "notebooks").glob("*.ipynb")):
        cells = json.loads(file.read_text())["cells"]
        title, _, text = "".join(cells[0]["source"]).partition("\n")
        parts = [f"**[{title.lstrip('# ')}](notebooks/{file.name})**", _teaser(text)]
        outputs = [output.get("data", {}) for cell in cells for output in cell.get("outputs", [])]
        picture = next((data["image/png"] for data in outputs if "image/png" in data), None)
        if picture:
            thumb = f"notebooks/thumbs/{file.stem[:2]}.png"
            thumbs[thumb] = base64.b64decode(picture)
            parts.insert(0, f"[![]({thumb}){{ loading=lazy }}](notebooks/{file.name})")
        cards.append("-   " + "\n\n    ".join(parts) + "\n")
    head = [
        WITHOUT_TOC,
        "# Tutorials",
        "",
        "Each is a notebook of the repository, shown as it ran last.",
        "",
        '<div class="grid cards" markdown>',
        "",
    ]
    return thumbs | {"tutorials.md": "\n".join([*head, *cards, "</div>", ""])}


def _teaser(text):
    """The first sentences of the first paragraph that fit on a card, without a sentence that ends in the middle of a formula."""
    paragraph = " ".join(text.strip().split("\n\n")[0].split())
    sentences = re.split(r"(?<=[.?!:]) (?=[A-Z])", paragraph)
    while len(sentences) > 1 and (len(" ".join(sentences)) > LONGEST_TEASER or sentences[-1][-1] not in ".?!:,"):
        sentences.pop()
    return re.sub("[:,]$", ".", " ".join(sentences))


def _reference():
    """A page for each topic, and one of all names."""
    pages, index = {}, [WITHOUT_TOC, "# Reference", "", "All public names by topic. `jl` is `jaxlag`.", ""]
    listed = {name for names in REFERENCE.values() for name in names.split()}
    public = re.findall(r"(\w+) as \1\b", (ROOT / "jaxlag" / "__init__.py").read_text())
    for name in public:
        if name not in listed and not any(entry.startswith(f"{name}.") for entry in listed):
            log.warning(f"jaxlag.{name} is in no topic of REFERENCE")
    for topic, names in REFERENCE.items():
        entries = [f"::: jaxlag.{name}\n    options:\n      heading: {name}\n      toc_label: {name}\n" for name in names.split()]
        pages[_reference_page(topic)] = "\n".join([f"# {topic}", "", *entries])
        page = posixpath.basename(_reference_page(topic))
        index += [
            f"## [{topic}]({page})",
            "",
            "\N{NO-BREAK SPACE}· ".join(f"[`{name}`]({page}#jaxlag.{name})" for name in names.split()),
            "",
        ]
    return pages | {"reference/index.md": "\n".join(index)}


def _reference_page(topic):
    return f"reference/{topic.lower().replace(' ', '_')}.md"
