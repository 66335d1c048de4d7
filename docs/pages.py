"""Gathers the pages of the site: README, notebooks, and a reference of all public names by topic."""

import shutil
from pathlib import Path

HERE = Path(__file__).parent
ROOT, PAGES = HERE.parent, HERE / "pages"
REFERENCE = {
    "Systems": "System virtual_work rate substitute Signal dissipation.sliding dissipation.viscous dissipation.drag dissipation.power_law "
    "dissipation.stribeck dissipation.speed",
    "At one state": "acceleration Acceleration mass_matrix momentum energy constraint_jacobian constraint_residual constraint_force powers "
    "consistent_state examine",
    "Motions": "simulate simulate_many Trajectory Instant Interpolated load Dop853 Dopri5 Projection Baumgarte NoStabilisation "
    "StickSlip Regularised",
    "Identification": "Experiment fit fit_each Fit Interval Prediction regress Regression validate Validation compare Comparison "
    "information Information Huber learnt.ConvexDissipation learnt.PassiveDissipation learnt.Potential learnt.ConvexPotential",
    "On paper": "equations Equations to_sympy",
    "Pictures": "plot.motion plot.phase plot.forces plot.energy plot.balance plot.friction plot.fit plot.parameters plot.convergence "
    "plot.equations animate",
}


def on_config(config):
    """Before mkdocs looks for pages."""
    (PAGES / "notebooks").mkdir(parents=True, exist_ok=True)
    (PAGES / "index.md").write_text((ROOT / "README.md").read_text())
    for picture in (ROOT / "notebooks").glob("*.png"):
        shutil.copy(picture, PAGES / "notebooks" / picture.name)
    titles = []
    for notebook in sorted((ROOT / "notebooks").glob("*.ipynb")):
        (PAGES / "notebooks" / notebook.name).write_text(notebook.read_text().replace("../README.md", "../../index.html"))
        titles.append(f"- [{notebook.stem[:2]} {notebook.stem[3:].replace('_', ' ')}](notebooks/{notebook.name})")
    (PAGES / "notebooks.md").write_text("# Notebooks\n\n" + "\n".join(titles) + "\n")
    topics = (f"## {topic}\n\n" + "\n".join(f"::: jaxlag.{name}\n" for name in names.split()) for topic, names in REFERENCE.items())
    (PAGES / "reference.md").write_text("# Reference\n\n" + "\n".join(topics))
    return config
