"""Moving pictures: the right number of frames, with everything where it is at that time."""

import base64
import dataclasses
import functools
import math
import re

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest
from PIL import Image

import jaxlag as jl
from jaxlag._motion.trajectory import Provenance
from jaxlag.examples import pendulum

matplotlib.use("Agg")
from matplotlib import animation
from matplotlib import pyplot as plt

UNITS = {"t": "s", "x": "m", "rod": "N"}


TS = np.linspace(0.0, 2.0, 101)
l, m, omega = 1.5, 2.0, 3.0


@functools.cache
def whirl():
    """Two seconds of a stone on a string that goes round at a steady rate, known in closed form: its tension is m l ω²."""
    x, y = l * np.cos(omega * TS), l * np.sin(omega * TS)
    q, qdot, qddot = (
        {"x": jnp.asarray(a), "y": jnp.asarray(b)} for a, b in ((x, y), (-omega * y, omega * x), (-(omega**2) * x, -(omega**2) * y))
    )
    stone = jl.System(lambda qdot, m: 0.5 * m * (qdot["x"] ** 2 + qdot["y"] ** 2), holonomic={"rod": pendulum.cartesian_rod})
    provenance = Provenance.of(stone, {"l": jnp.asarray(l), "m": jnp.asarray(m)})
    multipliers = {"rod": jnp.full(TS.shape, -m * l * omega**2)}
    return jl.results.Trajectory(jnp.asarray(TS), q, qdot, qddot, multipliers, jl.results.RESULTS.successful, {}, None, {}, provenance)


def bob(q):
    return q["x"], q["y"]


def half(q, l):
    return jnp.stack([q["x"], q["y"]]) * (l / 3.0)


def whirling(**options):
    return jl.plot.animate(
        whirl(), {"bob": bob, "half": half}, [((0.0, 0.0), "half"), ("half", "bob")], **({"units": UNITS, "fps": 10} | options)
    )


@pytest.mark.fast
def test_frames_are_where_the_motion_is():
    moving = whirling(trail=0.5)
    assert moving.frames == 21 and repr(moving) == "Animation(21 frames, 2.1 s)"
    i, sample = 7, 35  # both 0.7 s
    here = np.array([whirl().q["x"][sample], whirl().q["y"][sample]])
    paths, links, fixed, dots = (moving.ax.lines[part] for part in (slice(0, 2), slice(2, 4), slice(4, 5), slice(5, 7)))
    moving.draw(i)
    assert moving.ax.get_title(loc="left") == "t = 0.7 s"
    np.testing.assert_allclose(dots[0].get_xydata(), [here], atol=1e-6)
    np.testing.assert_allclose(links[0].get_xydata(), [[0, 0], here / 2], atol=1e-6)
    np.testing.assert_allclose(links[1].get_xydata(), [here / 2, here], atol=1e-6)
    np.testing.assert_allclose(fixed[0].get_xydata(), [[0, 0]])
    ts = np.linspace(0.2, 0.7, 21)
    np.testing.assert_allclose(paths[0].get_xydata(), l * np.stack([np.cos(omega * ts), np.sin(omega * ts)], axis=1), atol=1e-6)
    assert moving.ax.get_aspect() == 1
    limits = moving.ax.get_xlim()
    moving.draw(20)
    assert moving.ax.get_xlim() == limits and limits[0] < np.min(whirl().q["x"])
    assert not plt.get_fignums()  # a notebook would show it twice


def test_arrows_are_the_forces_of_the_constraints():
    moving = whirling(forces={"rod": "bob"})
    (arrow,) = moving.ax.collections
    assert arrow.get_label() == f"rod, up to {m * l * omega**2:.3g} N"
    length = 0.25 * 2 * l * np.sqrt(2)  # a quarter of the diagonal of the square around the circle
    for i in (3, 9):
        moving.draw(i)
        x = np.array([whirl().q["x"][5 * i], whirl().q["y"][5 * i]])
        np.testing.assert_allclose(arrow.get_offsets(), [x], atol=1e-6)
        np.testing.assert_allclose([arrow.U[0], arrow.V[0]], -x / l * length, atol=0.01)  # the extremes lie between two frames


def test_a_rod_between_two_bodies_pulls_at_both():
    """A dumb-bell that turns about its middle: −m (l/2) ω² on each end, along the rod."""
    out = l / 2 * np.stack([np.cos(omega * TS), np.sin(omega * TS)], axis=1)
    aside = l / 2 * omega * np.stack([-np.sin(omega * TS), np.cos(omega * TS)], axis=1)
    ends = lambda x: {"a": jnp.asarray(x), "b": jnp.asarray(-x)}
    energy = lambda qdot, m: 0.5 * m * (qdot["a"] @ qdot["a"] + qdot["b"] @ qdot["b"])
    dumb_bell = jl.System(energy, holonomic={"rod": lambda q, l: jnp.linalg.norm(q["a"] - q["b"]) - l})
    provenance = Provenance.of(dumb_bell, {"l": jnp.asarray(l), "m": jnp.asarray(m)})
    motion = ends(out), ends(aside), ends(-(omega**2) * out), {"rod": jnp.full(TS.shape, -m * l / 2 * omega**2)}
    turning = jl.results.Trajectory(jnp.asarray(TS), *motion, jl.results.RESULTS.successful, {}, None, {}, provenance)
    points = {"a": lambda q: q["a"], "b": lambda q: q["b"]}
    moving = jl.plot.animate(turning, points, [("a", "b")], forces={"rod": ("a", "b")}, fps=10)
    one, other = moving.ax.collections
    moving.draw(4)
    np.testing.assert_allclose([one.U[0], one.V[0]], -out[20] * np.hypot(one.U[0], one.V[0]) / (l / 2), atol=1e-6)
    np.testing.assert_allclose([other.U[0], other.V[0]], [-one.U[0], -one.V[0]], rtol=1e-6)
    (entry,) = moving.ax.get_legend().get_texts()
    assert entry.get_text() == f"rod, up to {m * l / 2 * omega**2:.3g}"


@pytest.mark.parametrize(("speed", "frames"), [(1.0, 21), (2.0, 11)])
def test_a_gif_has_a_frame_for_each_time(tmp_path, speed, frames):
    file = tmp_path / "whirl.gif"
    whirling(speed=speed).save(file, dpi=40)
    with Image.open(file) as gif:
        assert gif.n_frames == frames
        assert gif.info["duration"] == 100  # ms


def test_a_notebook_gets_a_small_page_with_buttons():
    page = whirling(fps=20)._repr_html_()
    pictures = re.findall(r'frames\[\d+\] = "data:image/png;base64,([^"]+)"', page)
    assert len(pictures) == 21  # every second of 41
    assert base64.b64decode(pictures[3]).startswith(b"\x89PNG")
    assert "<button" in page and len(page) < 21 * 6000 + 20_000


def test_it_is_drawn_on_the_axes_that_are_given(tmp_path):
    _, ax = plt.subplots()
    moving = whirling(ax=ax, trail=math.inf)
    assert moving.ax is ax
    moving.draw(20)
    assert len(ax.lines[0].get_xdata()) == 4 * 20 + 1
    moving.save(tmp_path / "whirl.html", dpi=30)
    assert "<button" in (tmp_path / "whirl.html").read_text()
    plt.close("all")


def test_a_motion_that_broke_off_is_shown_as_far_as_it_came():
    lost = lambda tree: jax.tree.map(lambda x: x.at[41:].set(jnp.nan), tree)
    parts = {name: lost(getattr(whirl(), name)) for name in ("q", "qdot", "qddot", "multipliers")}
    moving = jl.plot.animate(dataclasses.replace(whirl(), **parts), {"bob": bob}, forces={"rod": "bob"}, fps=50)
    assert moving.frames == 41
    parts = {name: jax.tree.map(lambda x: x * jnp.nan, part) for name, part in parts.items()}
    with pytest.raises(ValueError, match=r"`trajectory` must have at least two samples, but only 0 were computed\. Look at"):
        jl.plot.animate(dataclasses.replace(whirl(), **parts), {"bob": bob})


def test_a_file_that_cannot_be_written_is_refused(tmp_path, monkeypatch):
    with pytest.raises(ValueError, match=r"`file` must end with \.gif, \.mp4 or \.html, but is 'whirl\.avi'\. Rename it\."):
        whirling().save("whirl.avi")
    monkeypatch.setattr(animation.FFMpegWriter, "isAvailable", lambda: False)
    with pytest.raises(
        RuntimeError,
        match=r"`file` must not end with \.mp4 without ffmpeg, but is .*whirl\.mp4'\. Install ffmpeg, or save a \.gif\.",
    ):
        whirling().save(tmp_path / "whirl.mp4")


@pytest.mark.fast
@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"points": {}}, "`points` must name at least one point, but is empty. Give position maps"),
        ({"points": {"bob": lambda q: q["x"]}}, "`points` 'bob' must return a position (x, y), but returned 1 numbers."),
        ({"links": ["bob"]}, "`links` must be pairs, but hold 'bob'. Give the two ends"),
        ({"links": [("bob", "pin")]}, "`links` must join points or positions (x, y), but one ends at 'pin'. The points are bob."),
        ({"links": [("bob", (0.0, 0.0, 0.0))]}, "but one ends at (0.0, 0.0, 0.0). The points are bob."),
        ({"forces": {"string": "bob"}}, "`forces` must be of constraints of the system, but 'string' is not. There are rod."),
        ({"forces": {"rod": "pin"}}, "`forces` must act on points, but 'rod' is to act on 'pin'. The points are bob."),
        ({"forces": {"rod": ("bob", "pin")}}, "`forces` must act on points, but 'rod' is to act on 'pin'."),
        (
            {"points": {"bob": bob, "wall": lambda t: (0.0 * t, 0.0 * t)}, "forces": {"rod": "wall"}},
            "`forces` must name all points that a constraint acts through, but 'rod' does not act through wall alone. Name the points",
        ),
        ({"speed": 1e-3}, "`fps` and `speed` must give 2 to 2000 frames, but this motion of 2 gives 50001. Change `speed`, now 0.001"),
    ],
)
def test_what_does_not_fit_is_refused(change, sentence):
    with pytest.raises(ValueError, match=re.escape(sentence)):
        jl.plot.animate(whirl(), **({"points": {"bob": bob}} | change))
