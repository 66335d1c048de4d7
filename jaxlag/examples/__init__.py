"""The lecture's systems, ready to import: `from jaxlag.examples import pendulum, vehicle`."""
