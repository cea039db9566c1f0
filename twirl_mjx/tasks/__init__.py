"""Tasks (Markov decision processes) over the A1, and how to make their worlds."""
