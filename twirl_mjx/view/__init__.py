"""Moving pictures in a browser: a live page of a loop that people may touch, and replays."""
