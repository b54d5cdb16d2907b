"""A job on disk: its folder, inputs, results and report, and the processes that do its tasks."""
