"""File formats other than zoomjax's own: one module a format, a reader and a writer each."""
