"""The public functions, available through `import tasklens`.

A `Lens` has surfaces, distances and media (differentiable tensors). A `View` has the fields, wavelengths and pixels at
which it is evaluated. Lengths are in mm; wavelengths, pixels and spots are in um.

    import tasklens

    lens, view = tasklens.load_lens("lens.yaml")
    tasklens.analyse(lens, view)["rms_centroid_um"]
    captures = tasklens.simulate(lens, view, "photograph.jpg")
"""
