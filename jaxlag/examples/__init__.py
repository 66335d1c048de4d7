"""Example systems, ready to import: `from jaxlag.examples import pendulum, stribeck, vehicle`."""
