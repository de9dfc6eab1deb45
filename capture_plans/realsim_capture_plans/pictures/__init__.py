"""Plans as people look at them: charts of coverage and motion, the replay in the browser."""
