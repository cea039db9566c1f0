"""Statistics, figures and the report: files in, files out, no simulator and no accelerator."""
