"""The pipeline of Brandt, Ackermann and Grasshof (2018)."""
