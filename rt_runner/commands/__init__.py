"""One verb of ``rt-runner`` per file: ``add_parser(verbs)`` and ``run(args)``."""
