"""What is wrong with a mesh: `gather` collects facts from where it runs, `analyze` judges them, `report` prints."""
