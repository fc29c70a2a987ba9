"""SmartSteps on the bench: a line scanned, examined, its drives tried, their traces verified. Start with `family`."""
