"""Images in, images out: the only part of zoomjax that imports OpenCV."""
