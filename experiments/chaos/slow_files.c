/* Every call that looks at a file or folder below SLOW_FILES_BELOW takes SLOW_FILES_MS longer, as over a network, and is
 * counted: a line "<pid> <call> <path>" goes to the file SLOW_FILES_LOG where it is named. Loaded before libc
 * (LD_PRELOAD) in a command and in what it begins. See experiments/chaos/slow_logs.py. */

#define _GNU_SOURCE
#include <dirent.h>
#include <dlfcn.h>
#include <fcntl.h>
#include <limits.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <time.h>
#include <unistd.h>

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))

static void met(const char *call, const char *path)
{
    const char *folder = getenv("SLOW_FILES_BELOW"), *log = getenv("SLOW_FILES_LOG"), *ms = getenv("SLOW_FILES_MS");
    if (!folder || !path || strncmp(path, folder, strlen(folder)))
        return;
    long ns = ms ? (long)(1e6 * atof(ms)) : 0;
    struct timespec pause = {ns / 1000000000L, ns % 1000000000L};
    nanosleep(&pause, NULL);
    int file = log ? REAL(open)(log, O_WRONLY | O_APPEND | O_CREAT, 0600) : -1;
    if (file >= 0) {
        dprintf(file, "%d %s %s\n", (int)getpid(), call, path);
        close(file);
    }
}

static void met_open(const char *call, int fd)
{
    char entry[64], path[PATH_MAX];
    snprintf(entry, sizeof entry, "/proc/self/fd/%d", fd);
    ssize_t n = REAL(readlink)(entry, path, sizeof path - 1);
    path[n > 0 ? n : 0] = 0;
    met(call, path);
}

#define LOOKS(name, kind) \
    int name(const char *path, struct kind *into) \
    { \
        met(#name, path); \
        return REAL(name)(path, into); \
    }

LOOKS(stat, stat)
LOOKS(lstat, stat)
LOOKS(stat64, stat64)
LOOKS(lstat64, stat64)

#define OPENS(name) \
    int name(const char *path, int flags, ...) \
    { \
        va_list more; \
        va_start(more, flags); \
        mode_t mode = va_arg(more, mode_t); \
        va_end(more); \
        met(#name, path); \
        return REAL(name)(path, flags, mode); \
    }

OPENS(open)
OPENS(open64)

ssize_t read(int fd, void *into, size_t n)
{
    met_open("read", fd);
    return REAL(read)(fd, into, n);
}

ssize_t pread64(int fd, void *into, size_t n, off64_t at)
{
    met_open("pread64", fd);
    return REAL(pread64)(fd, into, n, at);
}

ssize_t readlink(const char *path, char *into, size_t n)
{
    met("readlink", path);
    return REAL(readlink)(path, into, n);
}

DIR *opendir(const char *path)
{
    met("opendir", path);
    met("getdents", path); /* its first names; a thousand more cost another call */
    return REAL(opendir)(path);
}

struct dirent64 *readdir64(DIR *folder)
{
    static __thread unsigned long n;
    if (++n % 1000 == 0)
        met_open("getdents", dirfd(folder));
    return REAL(readdir64)(folder);
}
