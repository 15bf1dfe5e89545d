"""``python -m zoomjax``, and ``zoomjax``: the command line.

Processes that detect lines import this module anew, as Python does on all systems: so it imports nothing.
"""


def main() -> None:
    """Run the command line."""
    from .app.cli import main as run

    run()


if __name__ == "__main__":
    main()
