"""Where the metrics of a run go: the table, TensorBoard, the terminal, and what a user adds."""
