"""What makes the documentation: ``python -m docs.make COMMAND``, run from the root of the repository."""
