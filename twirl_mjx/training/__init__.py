"""Where simulation, tasks, replay and learner meet: runs, their stages and their files."""
