"""``python -m zoomjax``, and ``zoomjax``: the command line.

Processes that detect lines import this module anew, as Python does on all systems: so it imports nothing.
"""


def main() -> None:
    """Run the command line."""
    from .app.ending import ending_at_once
    from .app.streams import open_streams

    open_streams()
    with ending_at_once():
        from .app.cli import main as run

        run()


if __name__ == "__main__":
    main()
