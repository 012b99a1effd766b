"""The messages between components: tasks, results, answers, events, problems, certificates."""
