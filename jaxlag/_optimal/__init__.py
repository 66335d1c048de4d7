"""Best motions: which input leads from here to there at the least cost."""
