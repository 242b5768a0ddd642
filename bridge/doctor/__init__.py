"""What is wrong with a mesh: `look` collects facts from where it runs, `findings` judges them, `report` prints."""
