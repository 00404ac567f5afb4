"""What is known after the data: draws with names, reports, files, predictions."""
