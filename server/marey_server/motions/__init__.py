"""Services that compute with motion: importing, exporting, previews, samples, searches, and coverage."""
