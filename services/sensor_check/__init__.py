"""Is a recording's data sound: scale, intrinsics, registration, timing, frozen or blank frames, speed."""
