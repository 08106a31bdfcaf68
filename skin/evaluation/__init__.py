"""What a trained model is worth: metrics, the threshold of the alarm, margins, streams."""
