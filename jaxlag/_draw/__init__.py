"""Pictures of motions, fits and equations, and animations. The home of Matplotlib, imported when the first picture is drawn."""
