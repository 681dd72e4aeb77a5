"""Structure from motion, for photographs and for videos where tracking fails."""
