"""Measurements, a module a page of `results`; from the top of a checkout: ``python -m benchmarks.fit``."""
