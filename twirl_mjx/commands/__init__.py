"""One module per command of ``twirl``: its options, and a ``main(argv)`` that runs it."""
