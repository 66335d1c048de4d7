"""Gathers the pages of the site: README and its companions, notebooks, and a reference of all public names by topic."""

import shutil
from pathlib import Path

HERE = Path(__file__).parent
ROOT, PAGES = HERE.parent, HERE / "pages"
TEXTS = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "docs/architecture.md": "architecture.md",
}
REFERENCE = {
    "Systems": "System Contact Newton Poisson Event Falling Rising Either Negative Every State Sampled "
    "virtual_work rate substitute Signal ZeroOrderHold Linear Cubic "
    "dissipation.sliding dissipation.viscous dissipation.drag dissipation.power_law dissipation.stribeck dissipation.speed",
    "Bodies in space": "rigid.rotation_x rigid.rotation_y rigid.rotation_z rigid.rotation rigid.euler rigid.Euler rigid.quaternion "
    "rigid.unit rigid.to_quaternion rigid.quaternion_rate rigid.rotation_vector rigid.angular_velocity rigid.kinetic_energy rigid.frame "
    "rigid.Frame rigid.spherical rigid.revolute "
    "rigid.prismatic rigid.cylindrical rigid.universal rigid.fixed rigid.same_axes rigid.on_plane rigid.length rigid.wheel_height "
    "rigid.rolling rigid.rolling_ball rigid.inertia.box rigid.inertia.cylinder rigid.inertia.hollow_cylinder rigid.inertia.sphere "
    "rigid.inertia.hollow_sphere rigid.inertia.ellipsoid rigid.inertia.steiner rigid.inertia.rotated rigid.inertia.principal_axes "
    "rigid.inertia.Principal rigid.inertia.matrix rigid.inertia.physical rigid.inertia.log_cholesky rigid.inertia.Body",
    "At one state": "acceleration Acceleration mass_matrix momentum energy constraint_jacobian constraint_residual constraint_force powers "
    "Residual consistent_state examine Examination",
    "Motions": "simulate simulate_many Trajectory FrictionState ContactState EventState RESULTS Instant Interpolated load Dop853 Dopri5 "
    "Projection Baumgarte NoStabilisation StickSlip Regularised keep_compiled",
    "Near a steady state": "equilibrium steady Equilibrium linearise LinearSystem Modes lowest_modes root_locus RootLocus Crossing "
    "periodic PeriodicOrbit stability_map StabilityMap",
    "Identification": "Experiment ModalTest FrequencyResponseTest fit fit_each Fit Channel Interval Prediction regress Regression Regress "
    "validate Validation compare Comparison information Information Huber learnt.ConvexDissipation learnt.PassiveDissipation "
    "learnt.Potential learnt.ConvexPotential",
    "On paper": "equations Equations LinearisedEquations to_sympy",
    "Pictures": "plot.motion plot.phase plot.forces plot.energy plot.balance plot.friction plot.bode plot.nyquist plot.root_locus "
    "plot.mode_shapes plot.stability_map "
    "plot.fit plot.parameters plot.convergence plot.equations animate",
}


def on_config(config):
    """Writes the pages before mkdocs looks for them."""
    (PAGES / "notebooks").mkdir(parents=True, exist_ok=True)
    for source, page in TEXTS.items():
        (PAGES / page).write_text(_relinked((ROOT / source).read_text()))
    shutil.copy(ROOT / "CITATION.cff", PAGES)
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


def _relinked(text):
    """A text of the repository, with links to the pages of the site in place of those to files."""
    for source, page in TEXTS.items():
        text = text.replace(f"]({source}", f"]({page}")
    return text
