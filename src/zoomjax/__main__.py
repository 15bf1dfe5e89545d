"""``python -m zoomjax``: the command line, where its entry point is not on the path."""

from .app.cli import main

if __name__ == "__main__":
    main()
