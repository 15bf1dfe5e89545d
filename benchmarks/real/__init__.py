"""Studies on real data: ``python -m benchmarks.real.study_zoomcam``, from the top of a checkout."""
