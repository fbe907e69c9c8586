// Stands for the driver library of a GPU: prints how its functions are called, for test_cuda_driver.py.
#define _GNU_SOURCE
#include <dlfcn.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>

int cuInit(unsigned flags) { return 0; }
int cuDriverGetVersion(int* version) { *version = 13000; return 0; }
int cuGetErrorString(int code, const char** text) { *text = "an illegal memory access was encountered"; return 0; }

int cuGetProcAddress_v2(const char* symbol, void** function, int version, uint64_t flags, int* status) {
    *function = dlsym(dlopen("libcuda.so.1", RTLD_NOLOAD | RTLD_NOW), symbol);
    if (status) *status = *function ? 0 : 1;
    return *function ? 0 : 500;
}

int cuDeviceGetAttribute(int* value, int attribute, int device) {
    *value = attribute == 16 ? 132 : attribute == 97 ? 232448 : -1;
    return 0;
}

static void* current = NULL;
int cuCtxGetCurrent(void** context) { *context = current; return 0; }
int cuCtxSetCurrent(void* context) { printf("context %p\n", current = context); return 0; }
int cuDevicePrimaryCtxRetain(void** context, int device) { *context = (void*)(uintptr_t)(0x100 + device); return 0; }

int cuLibraryLoadData(void** library, const void* code, void* a, void* b, unsigned c, void* d, void* e, unsigned f) {
    printf("load %s\n", (const char*)code);
    *library = (void*)0x10;
    return c || f;
}

int cuLibraryGetKernel(void** kernel, void* library, const char* name) {
    printf("kernel %s of %p\n", name, library);
    *kernel = (void*)0x20;
    return 0;
}

int cuKernelGetAttribute(int* value, int attribute, void* kernel, int device) { *value = 1024; return attribute != 1; }

int cuKernelSetAttribute(int attribute, int value, void* kernel, int device) {
    printf("attribute %d of %p on %d: %d\n", attribute, kernel, device, value);
    return 0;
}

int cuOccupancyMaxActiveBlocksPerMultiprocessor(int* blocks, void* kernel, int threads, size_t shared) {
    printf("occupancy of %p: %d, %zu\n", kernel, threads, shared);
    *blocks = 2;
    return 0;
}

static int print_launch(const char* how, void* kernel, const unsigned* sizes, unsigned shared, void* stream, void** arguments) {
    printf("%s %p: %u %u %u, %u %u %u, %u bytes, stream %p, batch %ld, particles %ld\n", how, kernel, sizes[0], sizes[1],
           sizes[2], sizes[3], sizes[4], sizes[5], shared, stream, ((long*)arguments[0])[0], ((long*)arguments[0])[1]);
    return sizes[0] == 13 ? 700 : 0;
}

int cuLaunchKernel(void* kernel, unsigned a, unsigned b, unsigned c, unsigned d, unsigned e, unsigned f, unsigned shared,
                   void* stream, void** arguments, void** extra) {
    const unsigned sizes[] = {a, b, c, d, e, f};
    return extra ? 1 : print_launch("launch", kernel, sizes, shared, stream, arguments);
}

int cuLaunchCooperativeKernel(void* kernel, unsigned a, unsigned b, unsigned c, unsigned d, unsigned e, unsigned f,
                              unsigned shared, void* stream, void** arguments) {
    const unsigned sizes[] = {a, b, c, d, e, f};
    return print_launch("together", kernel, sizes, shared, stream, arguments);
}
