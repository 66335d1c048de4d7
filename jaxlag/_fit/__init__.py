"""Identification: experiments, residuals, least squares, regression, and what the statistics say of an estimate."""
