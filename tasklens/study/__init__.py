"""What a study file may say, checked before the first job."""
