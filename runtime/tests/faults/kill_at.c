/* Ends the process by SIGKILL at the n-th call of a kind, as strace would inject it: NEARL_KILL_AT="write:17". Preloaded where strace is
 * missing or may not trace. What is called past the C library is not seen. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <signal.h>
#include <stdarg.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

static int left = -1;

static void look(const char *call) {
    static const char *at;
    if (!at) {
        at = getenv("NEARL_KILL_AT");
        if (!at) at = "";
        const char *number = strchr(at, ':');
        left = number ? atoi(number + 1) : 0;
    }
    size_t length = strlen(call);
    if (!strncmp(at, call, length) && at[length] == ':' && __atomic_sub_fetch(&left, 1, __ATOMIC_SEQ_CST) == 0)
        raise(SIGKILL);
}

#define NEXT(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))
#define OPENS(name)                                                                                    \
    int name(const char *path, int flags, ...) {                                                       \
        va_list more; va_start(more, flags); mode_t mode = va_arg(more, mode_t); va_end(more);         \
        look("openat"); return NEXT(name)(path, flags, mode);                                          \
    }
#define OPENS_AT(name)                                                                                 \
    int name(int at, const char *path, int flags, ...) {                                               \
        va_list more; va_start(more, flags); mode_t mode = va_arg(more, mode_t); va_end(more);         \
        look("openat"); return NEXT(name)(at, path, flags, mode);                                      \
    }
OPENS(open)
OPENS(open64)
OPENS_AT(openat)
OPENS_AT(openat64)
int mkdir(const char *path, mode_t mode) { look("mkdir"); return NEXT(mkdir)(path, mode); }
int ftruncate(int fd, off_t n) { look("ftruncate"); return NEXT(ftruncate)(fd, n); }
int ftruncate64(int fd, off64_t n) { look("ftruncate"); return NEXT(ftruncate64)(fd, n); }
int posix_fallocate(int fd, off_t a, off_t n) { look("fallocate"); return NEXT(posix_fallocate)(fd, a, n); }
ssize_t write(int fd, const void *from, size_t n) { look("write"); return NEXT(write)(fd, from, n); }
int fchmod(int fd, mode_t mode) { look("fchmod"); return NEXT(fchmod)(fd, mode); }
int rename(const char *a, const char *b) { look("rename"); return NEXT(rename)(a, b); }
int unlink(const char *path) { look("unlink"); return NEXT(unlink)(path); }
int unlinkat(int at, const char *path, int flags) { look("unlink"); return NEXT(unlinkat)(at, path, flags); }
