"""What is in a picture. Pure: pictures in, findings out."""
