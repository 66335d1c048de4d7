"""Identification: experiments, residuals, least squares, regression, statistics of the estimates."""
