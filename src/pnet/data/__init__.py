"""From scenes to batches: labels, augmentation, data sets, the LightningDataModule."""
