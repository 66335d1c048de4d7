"""Example systems, ready to import: `from jaxlag.examples import bicycle, pendulum, stribeck, vehicle`."""
