"""What ``bin/benchmark`` measures, one module per subcommand: ``add_arguments`` and ``run``.

``run`` yields one row after the other, each with the same keys, for table and JSON.
"""
