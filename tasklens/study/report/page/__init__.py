"""The page that tells the results of a study: one file of HTML, made from the files of the results alone."""
